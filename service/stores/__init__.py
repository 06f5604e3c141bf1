"""What `t6gps.open_store` gives: runs of a folder or of a server, as arrays and answers to SQL."""
