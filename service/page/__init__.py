"""The page of a server: what its runs do, in a browser (docs/page.md)."""
