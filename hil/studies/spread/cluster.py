"""Which Dask cluster works on a study. What crosses to it and back are pickles: they run code where they are opened."""

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pkxyz_ctrl.config.files import ConfigError

CERTIFICATES: Mapping[str, str] = {"tls_ca_file": "ca.pem", "tls_client_cert": "cert.pem", "tls_client_key": "key.pem"}
"""Files of ``--cluster-tls`` by what ``distributed.Security`` calls them."""


@dataclass(frozen=True)
class Cluster:
    """A scheduler's address, and the folder of certificates with which both sides show who they are."""

    address: str
    certificates: Path | None = None

    @property
    def security(self) -> Any:
        """``distributed.Security``; None without encryption."""
        if self.certificates is None:
            return None
        from distributed import Security

        files = {name: str(self.certificates / file) for name, file in CERTIFICATES.items()}
        return Security(require_encryption=True, **files)  # type: ignore[no-untyped-call]


def cluster_at(address: str | None, certificates: str | Path | None) -> Cluster | None:
    """The cluster of ``--cluster`` and ``--cluster-tls``; None without an address.

    Raises ``ConfigError`` for one on another machine without TLS, and for certificates that are not there.
    """
    if address is None:
        if certificates is not None:
            raise ConfigError("--cluster-tls is for a scheduler: give its address with --cluster tls://HOST:PORT")
        return None
    is_encrypted = address.startswith("tls://")
    if is_encrypted and certificates is None:
        raise ConfigError(f"--cluster {address}: give the folder of its certificates with --cluster-tls")
    if certificates is not None and not is_encrypted:
        raise ConfigError(f"--cluster {address} does not ask for TLS: say tls:// where --cluster-tls has certificates")
    if not is_encrypted and not _is_this_machine(address):
        raise ConfigError(
            f"--cluster {address}: what crosses to another machine runs code here and there, so it needs TLS: start "
            "scheduler and workers with certificates, and give tls://HOST:PORT and --cluster-tls"
        )
    for file in CERTIFICATES.values() if certificates is not None else ():
        if not (Path(certificates or "") / file).is_file():
            raise ConfigError(f"--cluster-tls: {certificates}: has no {file}")
    return Cluster(address, None if certificates is None else Path(certificates))


def _is_this_machine(address: str) -> bool:
    """By its number: a name may lead anywhere, but for localhost."""
    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    if parts.scheme == "inproc":
        return True
    host = parts.hostname or ""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
