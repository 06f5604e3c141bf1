"""`python3 -m t6gps.service.launch.listing ROOT RUN`: the files of a run as JSON, `{path: [size, sha256]}`.

It runs where the run lies, for those who fetch it from elsewhere.
"""

from __future__ import annotations

import json
import sys
from dataclasses import astuple
from pathlib import Path

from t6gps.service.launch.fetch import FolderSource
from t6gps.storage import catalog
from t6gps.storage.errors import T6GpsError


def main(root: str, run: str) -> int:
    """Write the listing; exit code 2, and why in words, where there is none."""
    try:
        files = FolderSource(catalog.open_run(Path(root), run)).files()
    except T6GpsError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.write(json.dumps({path: astuple(file) for path, file in files.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
