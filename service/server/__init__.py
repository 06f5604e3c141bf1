"""The control plane of a root: runs over HTTP, for those who hold a token (docs/server.md)."""
