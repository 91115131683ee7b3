"""The recording of a run: one row a tick, streamed to disk, Parquet in the end.

While a run lasts its rows go, as they are in memory, to a journal beside the file (``recording.parquet.journal``, an
Arrow stream of one binary column): that costs the loop a tenth of a microsecond a tick, and whatever kills the program,
every batch written before stays readable. ``close`` takes the rows apart into columns, as Parquet, which could not be
read without the footer that comes last, and removes the journal.
``Recording.open`` reads either, so a recording whose program was killed opens like any other.
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

from pkxyz_ctrl.loop.row import ROW, columns

_BATCH_ROWS = 2048
_GROUP_ROWS = 8 * _BATCH_ROWS  # of the Parquet file: 7 MB at a time, and 10 minutes at 5 kHz are 180 groups
_KEY, _LAYOUT = b"pkxyz", b"layout"
_ROW_FIELD = pa.field("row", pa.binary(ROW.itemsize), nullable=False)

COLUMNS = tuple(name for field in ROW.names or () for name in columns(field))
"""Names of all columns, in order."""


class RecordingError(RuntimeError):
    """A recording that can't be written or read. The message says which file, why, and what is left of it."""


def journal_of(path: str | Path) -> Path:
    """Where the rows of a recording are while it is being written."""
    path = Path(path)
    return path.with_name(path.name + ".journal")


class RecordingWriter:
    """Writes blocks of ``ROW``; a context manager, which closes the file whatever ends the run."""

    def __init__(self, path: str | Path, metadata: dict[str, Any]) -> None:
        """``metadata``: plain data that goes along. Replaces an existing recording. Raises ``RecordingError``."""
        self.path = Path(path)
        self.ticks = 0
        self._schema = pa.schema([_ROW_FIELD], metadata=_packed(metadata) | {_LAYOUT: _layout()})
        self._buffer = np.zeros(_BATCH_ROWS, ROW)
        self._filled = 0
        self._closed = False
        self._failed = False
        try:
            self.path.unlink(missing_ok=True)
            self._sink = pa.OSFile(str(journal_of(self.path)), "wb")
            self._stream = pa.ipc.new_stream(self._sink, self._schema)
        except (OSError, pa.ArrowException) as error:
            raise RecordingError(f"{self.path}: cannot be written: {_reason(error)}") from None

    def write(self, block: NDArray[np.void]) -> None:
        """Add the rows of a block (n,) of ``ROW``; they are copied. Raises ``RecordingError``."""
        if self._closed:
            raise RecordingError(f"{self.path}: is closed, nothing can be added")
        done = 0
        while done < len(block):
            count = min(len(block) - done, _BATCH_ROWS - self._filled)
            self._buffer[self._filled : self._filled + count] = block[done : done + count]
            self._filled += count
            done += count
            if self._filled == _BATCH_ROWS:
                self._flush()

    def close(self) -> None:
        """Write what is buffered, turn the journal into Parquet. Raises ``RecordingError``; then the journal stays."""
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failed:
                self._flush()
                self._stream.close()
        except (OSError, pa.ArrowException) as error:
            raise self._lost(error) from None
        finally:
            self._sink.close()
        if not self._failed:
            recover(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _flush(self) -> None:
        if self._filled == 0:
            return
        try:
            rows = pa.FixedSizeBinaryArray.from_buffers(
                _ROW_FIELD.type, self._filled, [None, pa.py_buffer(self._buffer)]
            )
            self._stream.write_batch(pa.record_batch([rows], schema=self._schema))
        except (OSError, pa.ArrowException) as error:
            self._failed = True
            raise self._lost(error) from None
        self.ticks += self._filled
        self._filled = 0

    def _lost(self, error: Exception) -> RecordingError:
        return RecordingError(
            f"{self.path}: cannot go on recording: {_reason(error)}; the first {self.ticks} ticks are kept in "
            f"{journal_of(self.path).name} and open as before"
        )


def recover(path: str | Path) -> None:
    """Turn what the journal of ``path`` holds, whole or cut off anywhere, into Parquet. Raises ``RecordingError``."""
    path, journal = Path(path), journal_of(path)
    part = path.with_name(path.name + ".part")
    try:
        with _JournalBatches(journal) as (schema, batches), pq.ParquetWriter(
            part, schema, compression="zstd", compression_level=1, use_dictionary=False, write_page_checksum=True,
        ) as writer:  # fmt: skip
            for group in _grouped(batches):
                writer.write_table(pa.Table.from_batches(group, schema), row_group_size=_GROUP_ROWS)
        part.replace(path)
        journal.unlink()
    except (OSError, pa.ArrowException) as error:
        part.unlink(missing_ok=True)
        raise RecordingError(
            f"{path}: cannot be written: {_reason(error)}; its rows are kept in {journal.name}"
        ) from None


class Recording:
    """A finished recording, or the journal of one that was cut off. Columns are read when asked for."""

    def __init__(self, path: Path, metadata: dict[str, Any], file: pq.ParquetFile | None, table: Any) -> None:
        self.path = path
        self.metadata = metadata
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
                return cls(path, _metadata(file.schema_arrow, path), file, None)
            with _JournalBatches(journal_of(path)) as (schema, batches):
                table = pa.Table.from_batches(list(batches), schema)
            return cls(path, _metadata(schema, path), None, table)
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such recording") from None
        except (OSError, pa.ArrowException) as error:
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
                field: np.stack([batch.column(name).to_numpy() for name in columns(field)], axis=1)
                if len(columns(field)) > 1
                else batch.column(field).to_numpy()
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
        return [table.column(name).to_numpy() for name in names]


class _JournalBatches:
    """Opens a journal: its schema and its complete batches, up to where it was cut off."""

    def __init__(self, path: Path) -> None:
        self._source = pa.OSFile(str(path), "rb")

    def __enter__(self) -> tuple[pa.Schema, Iterator[pa.RecordBatch]]:
        reader = pa.ipc.open_stream(self._source)
        layout = (reader.schema.metadata or {}).get(_LAYOUT)
        if layout != _layout():
            raise pa.ArrowInvalid("is a journal of another version of this program, which can read it")
        schema = _schema({_KEY: reader.schema.metadata[_KEY]})
        return schema, (_batch(_rows(batch), schema) for batch in self._complete(reader))

    def __exit__(self, *_: object) -> None:
        self._source.close()

    @staticmethod
    def _complete(reader: Any) -> Iterator[pa.RecordBatch]:
        while True:
            try:
                batch = reader.read_next_batch()
            except (StopIteration, OSError, pa.ArrowException):
                return
            yield batch


def _grouped(batches: Iterator[pa.RecordBatch]) -> Iterator[list[pa.RecordBatch]]:
    group: list[pa.RecordBatch] = []
    for batch in batches:
        group.append(batch)
        if sum(len(b) for b in group) >= _GROUP_ROWS:
            yield group
            group = []
    if group:
        yield group


def _layout() -> bytes:
    """How a row lies in memory: whoever reads a journal must mean the same."""
    return repr(ROW.descr).encode()


def _packed(metadata: dict[str, Any]) -> dict[bytes, bytes]:
    return {_KEY: json.dumps(metadata, allow_nan=False).encode()}


def _rows(batch: pa.RecordBatch) -> NDArray[np.void]:
    column = batch.column(0)
    return np.frombuffer(column.buffers()[1], ROW, count=len(column), offset=column.offset * ROW.itemsize)


def _schema(metadata: dict[bytes, bytes]) -> pa.Schema:
    fields = [
        pa.field(name, pa.from_numpy_dtype(ROW[field].base), nullable=False)
        for field in ROW.names or ()
        for name in columns(field)
    ]
    return pa.schema(fields, metadata=metadata)


def _metadata(schema: pa.Schema, path: Path) -> dict[str, Any]:
    text = (schema.metadata or {}).get(_KEY)
    if text is None:
        raise RecordingError(f"{path}: is Parquet, but not a recording of this program")
    found: dict[str, Any] = json.loads(text)
    return found


def _batch(block: NDArray[np.void], schema: pa.Schema) -> pa.RecordBatch:
    arrays = []
    for field in ROW.names or ():
        values = block[field]
        parts = [values] if values.ndim == 1 else values.T
        arrays += [pa.array(np.ascontiguousarray(part)) for part in parts]
    return pa.record_batch(arrays, schema=schema)


def _reason(error: Exception) -> str:
    """The operating system's words where there are some, else the first line of the library's."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno).lower()
    return (str(error).splitlines() or ["unknown error"])[0]
