"""Tables as one piece of memory, an Arrow IPC stream each: how they are sent to another process, and written to a file.

The reader's tables lie in the same memory; a generic pickle handles each column and each buffer by itself.
"""

from __future__ import annotations

import pyarrow as pa


def pack(*tables: pa.Table) -> pa.Buffer:
    """The tables as streams, one after the other."""
    sink = pa.BufferOutputStream()
    for table in tables:
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
    return sink.getvalue()


def unpack(packed: pa.Buffer | pa.NativeFile, n: int) -> list[pa.Table]:
    """The first n tables of a piece of memory or a file, without a copy. ArrowException when one is damaged."""
    source = pa.BufferReader(packed) if isinstance(packed, pa.Buffer) else packed
    return [pa.ipc.open_stream(source).read_all() for _ in range(n)]
