"""The other end of `service.server`: what goes over the wire, and the client."""
