"""The table of all devices: a folder of Parquet files, each of a part or some, which any reader of Parquet takes as one
table.
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason

_KEY = b"pkxyz_wafer_study"


class Table:
    """Parts of one study. A part is there whole or not at all."""

    def __init__(self, folder: Path, digest: str) -> None:
        """Look at what is there. Raises ``ConfigError`` for another study's."""
        self._folder, self._digest = folder, digest
        self._files: list[range] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob("part-*.parquet")):
                said = (pq.read_schema(path).metadata or {}).get(_KEY)
                if said is None or json.loads(said)["digest"] != digest:
                    raise ConfigError(
                        f"{path}: holds devices of another study (process, stage, seed or what is run have changed "
                        "since); give another --out"
                    )
                first, _, last = path.stem.removeprefix("part-").partition("-")
                self._files.append(range(int(first), int(last or first) + 1))
        except ConfigError:
            raise
        except OSError as error:
            raise ConfigError(f"{folder}: {reason(error)}; give another --out") from None
        except (ValueError, KeyError, pa.ArrowException) as error:
            raise ConfigError(f"{folder}: is not a table of devices: {error}; give another --out") from None

    @property
    def parts(self) -> set[int]:
        """Those that are there."""
        return {part for parts in self._files for part in parts}

    def add(self, parts: range, columns: dict[str, NDArray[Any]]) -> None:
        """Keep parts, at once."""
        schema = pa.schema(
            [pa.field(name, pa.from_numpy_dtype(v.dtype), nullable=False) for name, v in columns.items()]
        )
        schema = schema.with_metadata({_KEY: json.dumps({"digest": self._digest, "part": parts.start}).encode()})
        path = self._path(parts)
        new = path.with_suffix(".new")
        pq.write_table(pa.table([pa.array(v) for v in columns.values()], schema=schema), new, compression="zstd")
        os.replace(new, path)
        self._files.append(parts)

    def read(self, names: Sequence[str], devices: int) -> dict[str, NDArray[Any]]:
        """Columns of the devices below a number, in their order, of the parts that are there."""
        read = [
            pq.read_table(self._path(parts), columns=list(dict.fromkeys((*names, "device"))))
            for parts in sorted(self._files, key=lambda parts: parts.start)
        ]
        whole = pa.concat_tables(read)
        keep = whole.column("device").to_numpy() < devices
        return {name: np.asarray(whole.column(name).to_numpy())[keep] for name in names}

    def _path(self, parts: range) -> Path:
        last = f"-{parts[-1]:06d}" if len(parts) > 1 else ""
        return self._folder / f"part-{parts[0]:06d}{last}.parquet"
