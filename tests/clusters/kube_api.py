"""As much of a Kubernetes API server as kubectl needs to create, get, patch, delete, exec: `with serving(store)`.

It refuses what Kubernetes refuses: fields that its schemas do not have, names that are taken, unknown namespaces.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import os
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import jsonschema
import kubernetes_validate
from pods_of_processes import Container

NAMESPACE = "default"
KINDS = {
    "configmaps": ("v1", "ConfigMap"),
    "namespaces": ("v1", "Namespace"),
    "pods": ("v1", "Pod"),
    "persistentvolumeclaims": ("v1", "PersistentVolumeClaim"),
    "networkpolicies": ("networking.k8s.io/v1", "NetworkPolicy"),
    "rayjobs": ("ray.io/v1", "RayJob"),
    "rayclusters": ("ray.io/v1", "RayCluster"),
}
SHORT = {"persistentvolumeclaims": ["pvc"]}
CORE_VERSION = "1.37"
GUID = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
"""Of RFC 6455, for the handshake of a WebSocket."""
OUT, ERROR, STATUS = 1, 2, 3
"""Channels of exec."""


class Refused(Exception):
    """A request that is refused: HTTP status, reason, message."""


@dataclass
class Store:
    """Objects by kind and name, and who carries out what they ask for. Its lock is held while they change."""

    objects: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    lock: threading.RLock = field(default_factory=threading.RLock)
    deleted: Callable[[str, dict[str, Any]], None] = lambda plural, found: None
    container: Callable[[str, str], Container | None] = lambda pod, name: None
    without: tuple[str, ...] = ()
    """Fields that the installed version of KubeRay does not have yet."""

    def of(self, plural: str) -> list[dict[str, Any]]:
        with self.lock:
            return [found for (kind, _), found in self.objects.items() if kind == plural]

    def create(self, plural: str, new: dict[str, Any], dry_run: bool = False) -> dict[str, Any]:
        name = new["metadata"]["name"]
        check(plural, new, self.without)
        with self.lock:
            if (plural, name) in self.objects:
                raise Refused(409, "AlreadyExists", f'{plural} "{name}" already exists')
            uid = hashlib.sha256(os.urandom(16)).hexdigest()[:32]
            new["metadata"] |= {"uid": uid, "namespace": NAMESPACE, "resourceVersion": "1"}
            if not dry_run:
                self.objects[plural, name] = new
        return new

    def get(self, plural: str, name: str) -> dict[str, Any]:
        with self.lock:
            if (plural, name) not in self.objects:
                raise Refused(404, "NotFound", f'{plural} "{name}" not found')
            return self.objects[plural, name]

    def patch(self, plural: str, name: str, changes: list[dict[str, Any]]) -> dict[str, Any]:
        with self.lock:
            found = json.loads(json.dumps(self.get(plural, name)))
            for change in changes:
                *parents, last = [int(key) if key.isdigit() else key for key in change["path"].split("/")[1:]]
                place = found
                for key in parents:
                    place = place[key]
                assert change["op"] == "add" or last in place, change
                place[last] = change["value"]
            check(plural, found, self.without)
            self.objects[plural, name] = found
            return found

    def delete(self, plural: str, name: str) -> dict[str, Any]:
        found = self.get(plural, name)
        with self.lock:
            del self.objects[plural, name]
        self.deleted(plural, found)
        return found


def check(plural: str, new: dict[str, Any], without: tuple[str, ...] = ()) -> None:
    """Refuse an object that Kubernetes would refuse, unknown fields included."""
    faults: list[str] = []
    if plural.startswith("ray"):
        schema = ray_schema(plural)
        if schema is not None:
            faults = [fault.message for fault in jsonschema.Draft202012Validator(schema).iter_errors(new)]
        faults += [f'unknown field "spec.{field}"' for field in without if f'"{field}"' in json.dumps(new["spec"])]
        cluster = new["spec"].get("rayClusterSpec", new["spec"])
        groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
        parts = [{"apiVersion": "v1", "kind": "Pod", "metadata": {}, **group["template"]} for group in groups]
    else:
        parts = [{key: value for key, value in new.items() if key != "status"}]
    for part in parts:
        try:
            kubernetes_validate.validate(part, CORE_VERSION, strict=True)
        except kubernetes_validate.ValidationError as error:
            faults.append(error.message)
    if faults:
        kind = new["kind"]
        raise Refused(400, "BadRequest", f'{kind} in version "v1" cannot be handled as a {kind}: {"; ".join(faults)}')


def ray_schema(plural: str) -> dict[str, Any] | None:
    """KubeRay's schema of a kind, closed against unknown fields; None without T6GPS_KUBERAY_SCHEMAS.

    That is a folder with rayjobs.v1.json.gz and rayclusters.v1.json.gz: `openAPIV3Schema` of its resource definitions.
    """
    folder = os.environ.get("T6GPS_KUBERAY_SCHEMAS")
    if folder is None:
        return None
    return _closed(json.loads(gzip.decompress((Path(folder) / f"{plural}.v1.json.gz").read_bytes())))


def _closed(schema: Any) -> Any:
    if isinstance(schema, list):
        return [_closed(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    if "properties" in schema and not schema.get("x-kubernetes-preserve-unknown-fields"):
        schema = {"additionalProperties": False, **schema}
    return {key: _closed(value) for key, value in schema.items()}


class Handler(BaseHTTPRequestHandler):
    """One request of kubectl."""

    protocol_version = "HTTP/1.1"
    store: Store

    def log_message(self, *_: object) -> None: ...

    def do_GET(self) -> None:
        self.answer(self.read)

    def do_POST(self) -> None:
        dry_run = self.query.get("dryRun") == ["All"]
        self.answer(lambda: (self.store.create(self.named()[0], self.body(), dry_run), 201))

    def do_PATCH(self) -> None:
        self.answer(lambda: (self.store.patch(*self.named(), self.body()), 200))  # type: ignore[arg-type]

    def do_DELETE(self) -> None:
        self.body()
        self.answer(lambda: (self.store.delete(*self.named()), 200))

    @property
    def path_only(self) -> str:
        return urlsplit(self.path).path

    @property
    def query(self) -> dict[str, list[str]]:
        return parse_qs(urlsplit(self.path).query)

    def body(self) -> Any:
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        return json.loads(content) if content else None

    def named(self) -> tuple[str, str]:
        """Kind and name of a path .../namespaces/NAMESPACE/KIND[/NAME]."""
        parts = self.path_only.strip("/").split("/")
        at = parts.index("namespaces")
        if parts[at + 1] != NAMESPACE:
            raise Refused(404, "NotFound", f'namespaces "{parts[at + 1]}" not found')
        return parts[at + 2], parts[at + 3] if len(parts) > at + 3 else ""

    def answer(self, ask: Callable[[], tuple[Any, int]]) -> None:
        try:
            said, code = ask()
        except Refused as refused:
            code, reason, message = refused.args
            said = {"kind": "Status", "apiVersion": "v1", "status": "Failure",
                    "message": message, "reason": reason, "code": code}  # fmt: skip
        if said is None:
            return
        with self.store.lock:
            content = json.dumps(said).encode()
        self.send_response(code)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def read(self) -> tuple[Any, int]:
        path = self.path_only
        if "/namespaces/" not in path:
            return discovery(path), 200
        plural, name = self.named()
        if path.endswith("/exec"):
            self.execute(name)
            return None, 101
        if name:
            return self.store.get(plural, name), 200
        wanted = dict(pair.split("=") for pair in self.query.get("labelSelector", [""])[0].split(",") if pair)
        found = [one for one in self.store.of(plural) if wanted.items() <= one["metadata"].get("labels", {}).items()]
        version, kind = KINDS[plural]
        return {"kind": f"{kind}List", "apiVersion": version, "metadata": {}, "items": found}, 200

    def execute(self, pod: str) -> None:
        """Run a command in a container, and send what it writes over a WebSocket."""
        container = self.store.container(pod, self.query["container"][0])
        if container is None:
            raise Refused(404, "NotFound", f'pods "{pod}" not found')
        accept = base64.b64encode(hashlib.sha1((self.headers["Sec-WebSocket-Key"] + GUID).encode()).digest()).decode()
        self.send_response(101)
        for header, value in {
            "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Accept": accept,
            "Sec-WebSocket-Protocol": self.headers["Sec-WebSocket-Protocol"].split(",")[0],
        }.items():  # fmt: skip
            self.send_header(header, value)
        self.end_headers()
        process, sending = container.call(self.query["command"]), threading.Lock()

        def copy(channel: int, stream: Any) -> None:
            while piece := stream.read1(1 << 15):
                self.frame(bytes([channel]) + piece, sending)

        reading = threading.Thread(target=copy, args=(ERROR, process.stderr))
        reading.start()
        copy(OUT, process.stdout)
        reading.join()
        code = process.wait()
        status: dict[str, Any] = {"metadata": {}, "status": "Success"}
        if code:
            causes = [{"reason": "ExitCode", "message": str(code)}]
            status = {"metadata": {}, "status": "Failure", "reason": "NonZeroExitCode", "details": {"causes": causes},
                      "message": f"command terminated with non-zero exit code: exit status {code}"}  # fmt: skip
        self.frame(bytes([STATUS]) + json.dumps(status).encode(), sending)
        self.wfile.write(b"\x88\x02" + struct.pack(">H", 1000))
        self.close_connection = True

    def frame(self, content: bytes, sending: threading.Lock) -> None:
        """Send a binary frame."""
        size = len(content)
        length = bytes([size]) if size < 126 else b"\x7e" + struct.pack(">H", size)
        with sending:
            self.wfile.write(b"\x82" + length + content)
            self.wfile.flush()


def discovery(path: str) -> dict[str, Any]:
    """What kubectl asks before it asks for objects: groups, kinds, and which options they take."""
    groups = sorted({version for version, _ in KINDS.values()} - {"v1"})
    if path == "/version":
        return {"major": "1", "minor": "37", "gitVersion": "v1.37.0"}
    if path == "/api":
        return {"kind": "APIVersions", "versions": ["v1"]}
    if path == "/apis":
        versions = [{"groupVersion": group, "version": "v1"} for group in groups]
        return {"kind": "APIGroupList", "apiVersion": "v1", "groups": [
            {"name": version["groupVersion"].split("/")[0], "versions": [version], "preferredVersion": version}
            for version in versions
        ]}  # fmt: skip
    if path == "/openapi/v3":
        names = ["api/v1", *(f"apis/{group}" for group in groups)]
        return {"paths": {name: {"serverRelativeURL": f"/openapi/v3/{name}"} for name in names}}
    version = path.removeprefix("/openapi/v3").removeprefix("/apis/").removeprefix("/api/")
    kinds = {plural: kind for plural, (of, kind) in KINDS.items() if of == version}
    if not kinds:
        raise Refused(404, "NotFound", f"the server could not find {path}")
    if path.startswith("/openapi/v3/"):
        group = version.rpartition("/")[0]
        option = [{"name": name, "in": "query", "schema": {"type": "string"}} for name in ("fieldValidation", "dryRun")]
        return {"openapi": "3.0.0", "info": {"title": "", "version": ""}, "paths": {
            f"/{plural}": {"patch": {"parameters": option, "responses": {}, "x-kubernetes-group-version-kind":
                                     {"group": group, "version": "v1", "kind": kind}}}
            for plural, kind in kinds.items()
        }}  # fmt: skip
    verbs = ["create", "delete", "get", "list", "patch"]
    return {"kind": "APIResourceList", "groupVersion": version, "resources": [
        {"name": plural, "singularName": kind.lower(), "namespaced": plural != "namespaces", "kind": kind,
         "verbs": verbs, "shortNames": SHORT.get(plural, [])}
        for plural, kind in kinds.items()
    ]}  # fmt: skip


@contextmanager
def serving(store: Store) -> Iterator[str]:
    """The address of a server of these objects, on loopback."""
    handler = type("Serving", (Handler,), {"store": store})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.1,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def kubeconfig(address: str) -> dict[str, Any]:
    """What leads kubectl there, as the context `stand-in`."""
    return {
        "apiVersion": "v1", "kind": "Config", "current-context": "stand-in",
        "clusters": [{"name": "stand-in", "cluster": {"server": address}}],
        "contexts": [{"name": "stand-in", "context": {"cluster": "stand-in", "user": "tester"}}],
        "users": [{"name": "tester", "user": {}}],
    }  # fmt: skip
