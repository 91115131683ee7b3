"""The recording of a run: one row a tick, streamed to disk, Parquet in the end.

While a run lasts its rows go, as they are in memory, to a journal beside the file (``recording.parquet.journal``): that
costs the loop a tenth of a microsecond a tick, and whatever kills the program, every row written before stays readable.
``close`` takes the rows apart into columns, as Parquet, which could not be read without the footer that comes last, and
removes the journal. ``Recording.open`` reads either, so a recording whose program was killed opens like any other; it
says so itself (``whole``), and goes on saying so.
"""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hil.recording.journal import JournalReader, JournalWriter, RecordingError, journal_of
from pkxyz_ctrl.loop.row import ROW, columns

__all__ = ["COLUMNS", "Recording", "RecordingError", "RecordingWriter", "journal_of", "recover"]

_BATCH_ROWS = 2048
_GROUP_ROWS = 8 * _BATCH_ROWS  # of the Parquet file: 7 MB at a time, and 10 minutes at 5 kHz are 180 groups
_KEY, _END = b"pkxyz", b"pkxyz_end"

COLUMNS = tuple(name for field in ROW.names or () for name in columns(field))
"""Names of all columns, in order."""


class RecordingWriter:
    """Writes blocks of ``ROW``; a context manager, which closes the file whatever ends the run."""

    def __init__(self, path: str | Path, metadata: dict[str, Any]) -> None:
        """``metadata``: plain data that goes along. Replaces an existing recording. Raises ``RecordingError``."""
        self.path = Path(path)
        self._buffer = np.zeros(_BATCH_ROWS, ROW)
        self._bytes = self._buffer.view(np.uint8).reshape(_BATCH_ROWS, -1)  # a copy of fields takes five times longer
        self._filled = 0
        self._closed = False
        self._failure: str | None = None
        try:
            self.path.unlink(missing_ok=True)
            self._journal = JournalWriter(journal_of(self.path), metadata)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {_reason(error)}") from None

    @property
    def ticks(self) -> int:
        """Rows that are safe from whatever ends this program."""
        return self._journal.ticks

    def write(self, block: NDArray[np.void]) -> None:
        """Add the rows of a block (n,) of ``ROW``; they are copied, or safe at once. Raises ``RecordingError``."""
        if self._closed:
            raise RecordingError(f"{self.path}: is closed, nothing can be added")
        rows = np.ascontiguousarray(block, ROW)
        if len(rows) >= _BATCH_ROWS:
            self.flush()
            self._append(rows)
            return
        done, added = 0, rows.view(np.uint8).reshape(-1, ROW.itemsize)
        while done < len(rows):
            count = min(len(rows) - done, _BATCH_ROWS - self._filled)
            self._bytes[self._filled : self._filled + count] = added[done : done + count]
            self._filled += count
            done += count
            if self._filled == _BATCH_ROWS:
                self.flush()

    def flush(self) -> None:
        """Hand all rows to the operating system. Raises ``RecordingError``."""
        filled, self._filled = self._filled, 0
        if filled > 0:
            self._append(self._buffer[:filled])

    def _append(self, rows: NDArray[np.void]) -> None:
        if self._failure is None:
            try:
                self._journal.append(rows)
                return
            except OSError as error:
                self._failure = (
                    f"{self.path}: cannot go on recording: {_reason(error)}; the first {self.ticks} ticks are kept in "
                    f"{journal_of(self.path).name} and open as before"
                )
        raise RecordingError(self._failure)

    def close(self, *, whole: bool = True) -> None:
        """Write what is buffered, turn the journal into Parquet; ``whole``: nothing is missing at its end.

        Raises ``RecordingError``; then the journal stays.
        """
        if self._closed:
            return
        self.leave()
        if self._failure is None:
            recover(self.path, whole=whole)

    def leave(self) -> None:
        """Write what is buffered and leave the journal as it is: it opens, and says that it is not whole.

        Raises ``RecordingError``.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._failure is None:
                self.flush()
        finally:
            self._journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close(whole=kind is None)


def recover(path: str | Path, *, whole: bool = False) -> None:
    """Turn what the journal of ``path`` holds, cut off anywhere, into Parquet. Raises ``RecordingError``."""
    path, journal = Path(path), journal_of(path)
    part = path.with_name(path.name + ".part")
    try:
        rows = JournalReader(journal)
        end = {"whole": whole, "ticks": rows.ticks}
        schema = _schema({_KEY: json.dumps(rows.metadata).encode(), _END: json.dumps(end).encode()})
        with pq.ParquetWriter(
            part, schema, compression="zstd", compression_level=1, use_dictionary=False, write_page_checksum=True,
        ) as writer:  # fmt: skip
            for batches in _groups_of(rows, schema):
                writer.write_table(pa.Table.from_batches(batches, schema), row_group_size=_GROUP_ROWS)
        part.replace(path)
        journal.unlink()
    except (OSError, pa.ArrowException) as error:
        part.unlink(missing_ok=True)
        raise RecordingError(
            f"{path}: cannot be written: {_reason(error)}; its rows are kept in {journal.name}"
        ) from None


class Recording:
    """A finished recording, or the journal of one that was cut off. Columns are read when asked for.

    ``whole``: its writer closed it, so that nothing is missing at its end.
    """

    def __init__(
        self, path: Path, metadata: dict[str, Any], file: pq.ParquetFile | None, table: Any, *, whole: bool
    ) -> None:
        self.path = path
        self.metadata = metadata
        self.whole = whole
        self._file = file
        self._table = table
        self.ticks: int = file.metadata.num_rows if file is not None else len(table)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open the recording at ``path``. Raises ``RecordingError``, never anything of pyarrow's."""
        path = Path(path)
        try:
            if path.is_file() or not journal_of(path).is_file():
                file = pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)
                metadata, end = _metadata(file.schema_arrow, path)
                whole = bool(end["whole"]) and end["ticks"] == file.metadata.num_rows
                return cls(path, metadata, file, None, whole=whole)
            rows, schema = JournalReader(journal_of(path)), _schema({})
            table = pa.Table.from_batches([b for group in _groups_of(rows, schema) for b in group], schema)
            return cls(path, rows.metadata, None, table, whole=False)
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such recording") from None
        except (OSError, ValueError, pa.ArrowException) as error:
            raise RecordingError(f"{path}: is not a readable recording: {_reason(error)}") from None

    def __getitem__(self, column: str) -> NDArray[Any]:
        """One scalar column (ticks,), such as ``position_x_m``."""
        return self._read([column])[0]

    def vector(self, field: str) -> NDArray[Any]:
        """One field of ``ROW``, (ticks,) or (ticks, 3), such as ``position_m``."""
        names = columns(field)
        arrays = self._read(names)
        return arrays[0] if len(names) == 1 else np.stack(arrays, axis=1)

    def blocks(self, fields: Sequence[str]) -> Iterator[dict[str, NDArray[Any]]]:
        """Fields of ``ROW`` for some thousand ticks at a time, so that no recording is too long."""
        names = [name for field in fields for name in columns(field)]
        self._require(names)
        for batch in self._groups(names):
            yield {
                field: np.stack([_numbers(batch.column(name)) for name in columns(field)], axis=1)
                if len(columns(field)) > 1
                else _numbers(batch.column(field))
                for field in fields
            }

    def rows(self, fields: Sequence[str]) -> Iterator[NDArray[np.void]]:
        """Rows (n,) of ``ROW``, some thousand ticks at a time, with the fields that are asked for; the others are 0."""
        for block in self.blocks(fields):
            rows = np.zeros(len(block[fields[0]]), ROW)
            for field in fields:
                rows[field] = block[field]
            yield rows

    def _groups(self, names: list[str]) -> Iterator[pa.RecordBatch | pa.Table]:
        """One row group at a time: pyarrow's own iterator reads ahead and keeps 150 MB of a long recording."""
        if self._file is None:
            yield from self._table.to_batches()
            return
        for group in range(self._file.num_row_groups):
            try:
                table = self._file.read_row_group(group, columns=names, use_threads=False)
            except (OSError, pa.ArrowException) as error:
                raise self._damaged(error) from None
            yield table

    def _require(self, names: Sequence[str]) -> None:
        known = self._table.column_names if self._file is None else self._file.schema_arrow.names
        for name in names:
            if name not in known:
                raise RecordingError(f"{self.path}: has no column {name!r}; it has: {', '.join(known)}")

    def _damaged(self, error: Exception) -> RecordingError:
        return RecordingError(f"{self.path}: is damaged: {_reason(error)}")

    def _read(self, names: Sequence[str]) -> list[NDArray[Any]]:
        self._require(names)
        try:
            table = self._table if self._file is None else self._file.read(columns=list(names))
        except (OSError, pa.ArrowException) as error:
            raise self._damaged(error) from None
        return [_numbers(table.column(name)) for name in names]


def _groups_of(rows: JournalReader, schema: pa.Schema) -> Iterator[list[pa.RecordBatch]]:
    """Rows as the batches of one row group after another, so that no recording is too long for memory."""
    for group in range(0, rows.ticks, _GROUP_ROWS):
        begins = range(group, min(group + _GROUP_ROWS, rows.ticks), _BATCH_ROWS)
        yield [_batch(rows.rows(begin, begin + _BATCH_ROWS), schema) for begin in begins]


def _schema(metadata: dict[bytes, bytes]) -> pa.Schema:
    fields = [
        pa.field(name, pa.from_numpy_dtype(ROW[field].base), nullable=False)
        for field in ROW.names or ()
        for name in columns(field)
    ]
    return pa.schema(fields, metadata=metadata)


def _metadata(schema: pa.Schema, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What goes along with the rows, and how the recording ended; ``ValueError`` for what can't be read."""
    said = schema.metadata or {}
    if _KEY not in said or _END not in said:
        raise RecordingError(f"{path}: is Parquet, but not a recording of this program, or of another version of it")
    found, end = json.loads(said[_KEY]), json.loads(said[_END])
    if not isinstance(found, dict) or not isinstance(end, dict) or end.keys() != {"whole", "ticks"}:
        raise ValueError("its metadata are damaged")
    return found, end


def _batch(block: NDArray[np.void], schema: pa.Schema) -> pa.RecordBatch:
    parts: list[NDArray[Any]] = []
    for field in ROW.names or ():
        values = block[field]
        parts.extend([values] if values.ndim == 1 else values.T)
    # pa.array and to_numpy load pandas where it is installed, to ask after series: that takes longer than a run
    buffers = [pa.py_buffer(np.ascontiguousarray(part)) for part in parts]
    columns = zip(schema.types, buffers, strict=True)
    return pa.record_batch([pa.Array.from_buffers(t, len(block), [None, b]) for t, b in columns], schema=schema)


def _numbers(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """The numbers of a column, read-only. Raises ``pa.ArrowInvalid`` where some are missing."""
    if column.null_count:
        raise pa.ArrowInvalid("a column has gaps")
    kind = np.dtype(column.type.to_pandas_dtype())
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    parts = [np.frombuffer(c.buffers()[1], kind, len(c), c.offset * kind.itemsize) for c in chunks if len(c)]
    return parts[0] if len(parts) == 1 else np.concatenate(parts) if parts else np.empty(0, kind)


def _reason(error: Exception) -> str:
    """The operating system's words where there are some, else the first line of the library's."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno).lower()
    return (str(error).splitlines() or ["unknown error"])[0]
