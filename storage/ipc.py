"""A table as one piece of memory, an Arrow IPC stream: how it is sent to another process, and written to a file.

The reader's table lies in the same memory; a generic pickle handles each column and each buffer by itself.
"""

from __future__ import annotations

import pyarrow as pa


def pack(table: pa.Table) -> pa.Buffer:
    """The table as a stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return sink.getvalue()


def unpack(packed: pa.Buffer | pa.NativeFile) -> pa.Table:
    """The table of a stream, or of the next one of a reader, without a copy. ArrowException when it is damaged."""
    return pa.ipc.open_stream(packed).read_all()
