"""The table of all devices: a folder of Parquet files, one a part, which any reader of Parquet takes as one table."""

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
        self.parts: set[int] = set()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob("part-*.parquet")):
                said = (pq.read_schema(path).metadata or {}).get(_KEY)
                if said is None or json.loads(said)["digest"] != digest:
                    raise ConfigError(
                        f"{path}: holds devices of another study (process, stage or seed have changed since); "
                        "give another --out"
                    )
                self.parts.add(int(path.stem.removeprefix("part-")))
        except ConfigError:
            raise
        except OSError as error:
            raise ConfigError(f"{folder}: {reason(error)}; give another --out") from None
        except (ValueError, KeyError, pa.ArrowException) as error:
            raise ConfigError(f"{folder}: is not a table of devices: {error}; give another --out") from None

    def add(self, part: int, columns: dict[str, NDArray[Any]]) -> None:
        """Keep a part, at once."""
        schema = pa.schema(
            [pa.field(name, pa.from_numpy_dtype(v.dtype), nullable=False) for name, v in columns.items()]
        )
        schema = schema.with_metadata({_KEY: json.dumps({"digest": self._digest, "part": part}).encode()})
        path = self._path(part)
        new = path.with_suffix(".new")
        pq.write_table(pa.table([pa.array(v) for v in columns.values()], schema=schema), new, compression="zstd")
        os.replace(new, path)
        self.parts.add(part)

    def read(self, names: Sequence[str], devices: int) -> dict[str, NDArray[Any]]:
        """Columns of the devices below a number, in their order, of the parts that are there."""
        read = [
            pq.read_table(self._path(part), columns=list(dict.fromkeys((*names, "device"))))
            for part in sorted(self.parts)
        ]
        whole = pa.concat_tables(read)
        keep = whole.column("device").to_numpy() < devices
        return {name: np.asarray(whole.column(name).to_numpy())[keep] for name in names}

    def _path(self, part: int) -> Path:
        return self._folder / f"part-{part:06d}.parquet"
