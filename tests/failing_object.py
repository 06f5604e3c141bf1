"""A process between a client and an object store that answers 500 for one object: `python FILE PORT PATH`.

It is a process since deltalake keeps Python's threads waiting while it waits for the store. It prints its own port.
"""

import sys
from contextlib import closing
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit


class Between(BaseHTTPRequestHandler):
    """Passes a request on as it is, and the answer back; a reader of the object is told of an internal error."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        with closing(HTTPConnection("127.0.0.1", int(sys.argv[1]))) as store:
            store.request(self.command, self.path, headers=dict(self.headers))
            answer = store.getresponse()
            content = answer.read()
        self.send_response(500 if urlsplit(self.path).path.endswith(sys.argv[2]) else answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in ("connection", "content-length", "transfer-encoding"):
                self.send_header(name, value)
        length = answer.getheader("content-length") if self.command == "HEAD" else None
        self.send_header("content-length", length or str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    do_HEAD = do_GET

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is logged."""


if __name__ == "__main__":
    with ThreadingHTTPServer(("127.0.0.1", 0), Between) as server:
        print(server.server_port, flush=True)
        server.serve_forever()
