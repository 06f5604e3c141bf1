"""What the server is asked, route by route."""
