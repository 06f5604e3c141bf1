"""Nodes of a Ray cluster on this machine for Ray's autoscaler, which imports this in a process of its own.

Each node is `ray start` with an address, a folder for its files and a folder /split of its own.
"""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

from ray.autoscaler.node_provider import NodeProvider
from ray.autoscaler.tags import (
    NODE_KIND_HEAD,
    STATUS_UP_TO_DATE,
    TAG_RAY_NODE_KIND,
    TAG_RAY_NODE_STATUS,
    TAG_RAY_USER_NODE_TYPE,
)

HEAD, PORT = "10.77.9.1", 6379
OWN_SPLIT = 'mount --make-rprivate / && mkdir -p "$0" && mount -t tmpfs none "$0" && exec "$@"'


def ray_start(folder: Path, address: str, *options: str) -> list[str]:
    """The command of a node's Ray: a node in a mount namespace, in which it alone sees what lies in FOLDER/split."""
    command = ["ray", "start", "--block", "--disable-usage-stats", f"--node-ip-address={address}"]
    command += ["--num-cpus=1", f"--object-store-memory={2 * 10**8}", f"--temp-dir={folder}/{address[-1]}", *options]
    return ["unshare", "--mount", "sh", "-c", OWN_SPLIT, f"{folder}/split", *command]


class Nodes(NodeProvider):
    """Processes in the place of machines. A node's name is its address."""

    def __init__(self, provider_config: dict[str, Any], cluster_name: str) -> None:
        super().__init__(provider_config, cluster_name)
        head = {TAG_RAY_NODE_KIND: NODE_KIND_HEAD, TAG_RAY_USER_NODE_TYPE: "head"}
        self.tags = {HEAD: head | {TAG_RAY_NODE_STATUS: STATUS_UP_TO_DATE}}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def non_terminated_nodes(self, tag_filters: dict[str, str]) -> list[str]:
        for node in [node for node, process in self.processes.items() if process.poll() is not None]:
            del self.processes[node], self.tags[node]
        return [node for node, tags in self.tags.items() if tag_filters.items() <= tags.items()]

    def is_running(self, node_id: str) -> bool:
        return node_id in self.tags

    def is_terminated(self, node_id: str) -> bool:
        return node_id not in self.tags

    def node_tags(self, node_id: str) -> dict[str, str]:
        return self.tags[node_id]

    def external_ip(self, node_id: str) -> str:
        return node_id

    def internal_ip(self, node_id: str) -> str:
        return node_id

    def set_node_tags(self, node_id: str, tags: dict[str, str]) -> None:
        self.tags[node_id].update(tags)

    def create_node(self, node_config: dict[str, Any], tags: dict[str, str], count: int) -> None:
        folder = Path(self.provider_config["folder"])
        for _ in range(count):
            address = next(f"10.77.9.{number}" for number in range(2, 10) if f"10.77.9.{number}" not in self.tags)
            command = ray_start(folder, address, f"--address={HEAD}:{PORT}")
            with (folder / f"{address}.log").open("ab") as log:
                process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            (folder / f"{address}.pid").write_text(str(process.pid))
            self.processes[address] = process
            self.tags[address] = tags | {TAG_RAY_NODE_STATUS: STATUS_UP_TO_DATE}

    def terminate_node(self, node_id: str) -> None:
        process = self.processes.pop(node_id)
        del self.tags[node_id]
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    @staticmethod
    def bootstrap_config(cluster_config: dict[str, Any]) -> dict[str, Any]:
        return cluster_config
