"""A cluster beyond this machine is reached by TLS only, with certificates on both sides."""

import multiprocessing
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from hil.commands.studies.montecarlo import montecarlo
from hil.commands.studies.tune import tune
from hil.commands.studies.wafer_yield import wafer_yield
from hil.studies.spread.cluster import CERTIFICATES, Cluster, cluster_at
from hil.studies.spread.processes import processes
from hil.studies.spread.workers import as_done, worker_pool
from pkxyz_ctrl.config.files import ConfigError

pytestmark = pytest.mark.at_rate
needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="certificates are made with openssl")

PAGE = Path(__file__).parents[3] / "docs" / "do" / "many-plants.md"


def openssl(folder, *words):
    subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


def certificates(folder, ca=None):
    """A folder as --cluster-tls wants it, signed by ``ca``'s authority, or by one of its own."""
    folder.mkdir()
    if ca is None:
        ca = folder
        openssl(folder, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", "-days",
                "2", "-subj", "/CN=authority")  # fmt: skip
    else:
        (folder / "ca.pem").write_bytes((ca / "ca.pem").read_bytes())
    openssl(folder, "req", "-newkey", "rsa:2048", "-nodes", "-keyout", "key.pem", "-out", "request.pem", "-subj",
            "/CN=localhost")  # fmt: skip
    openssl(folder, "x509", "-req", "-in", "request.pem", "-CA", str(ca / "ca.pem"), "-CAkey", str(ca / "ca.key"),
            "-CAcreateserial", "-out", "cert.pem", "-days", "2")  # fmt: skip
    return folder


def square(n):
    return n * n


def encrypted(folder):
    """A cluster in this process with the certificates of a folder."""
    from distributed import LocalCluster, Security

    roles = ("scheduler", "worker", "client")
    files = {f"tls_{role}_{kind}": str(folder / f"{kind}.pem") for role in roles for kind in ("cert", "key")}
    security = Security(require_encryption=True, tls_ca_file=str(folder / "ca.pem"), **files)
    return LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tls://",
        security=security, host="127.0.0.1",
    )  # fmt: skip


@needs_openssl
def test_work_crosses_encrypted_and_a_stranger_gets_nowhere(tmp_path):
    ours, stranger = certificates(tmp_path / "ours"), certificates(tmp_path / "stranger")
    with encrypted(ours) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        with worker_pool(1, cluster_at(address, certificates(tmp_path / "client", ours))) as (pool, width):
            assert dict(as_done(pool, width, square, range(5))) == {n: n * n for n in range(5)}
        with pytest.raises(ConfigError, match="no scheduler answers"), worker_pool(1, cluster_at(address, stranger)):
            pass


@needs_openssl
def test_the_certificate_that_the_page_makes_is_taken_and_keeps_strangers_out(tmp_path):
    (line,) = (line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("openssl "))
    for name in ("ours", "stranger"):
        (tmp_path / name).mkdir()
        subprocess.run(["sh", "-c", line], cwd=tmp_path / name, check=True, capture_output=True)
    with encrypted(tmp_path / "ours") as cluster:
        address = cluster.scheduler_address
        with worker_pool(1, cluster_at(address, tmp_path / "ours")) as (pool, width):
            assert dict(as_done(pool, width, square, range(5))) == {n: n * n for n in range(5)}
        stranger = cluster_at(address, tmp_path / "stranger")
        with pytest.raises(ConfigError, match="no scheduler answers"), worker_pool(1, stranger):
            pass


@pytest.mark.parametrize(
    "address", ["tcp://10.0.0.3:8786", "10.0.0.3:8786", "tcp://scheduler.lab:8786", "ws://[fe80::1]:1"]
)
def test_plain_tcp_to_another_machine_is_refused_before_anything_is_written(address, tmp_path):
    for command in (tune, montecarlo, wafer_yield):
        with pytest.raises(ConfigError, match="needs TLS") as caught:
            command(cluster=address, out=tmp_path / "out")
        assert "\n" not in str(caught.value)
    assert list((tmp_path / "out").glob("*")) == []


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "localhost:8786", "tcp://[::1]:1", "inproc://1.2.3.4/5/6"])
def test_on_this_machine_it_may_be_plain(address):
    assert cluster_at(address, None) == Cluster(address)
    assert cluster_at(address, None).security is None


def test_certificates_that_are_missing_or_of_no_use_are_told(tmp_path):
    assert cluster_at(None, None) is None
    for file in CERTIFICATES.values():
        with pytest.raises(ConfigError, match=f"has no {file}"):
            cluster_at("tls://10.0.0.3:1", tmp_path)
        (tmp_path / file).touch()
    assert cluster_at("tls://10.0.0.3:1", tmp_path) == Cluster("tls://10.0.0.3:1", tmp_path)
    for address, words in ((None, "give its address"), ("tcp://127.0.0.1:1", "say tls://")):
        with pytest.raises(ConfigError, match=words):
            cluster_at(address, tmp_path)
    with pytest.raises(ConfigError, match="with --cluster-tls"):
        cluster_at("tls://127.0.0.1:1", None)


def test_no_process_of_this_machine_ever_hears_ctrl_c():
    """All are started at once, with SIGINT kept from them from their first instruction on."""
    before = multiprocessing.active_children()
    with processes(3):
        begun = [child for child in multiprocessing.active_children() if child not in before]
        assert len(begun) == 3
        for child in begun:
            (blocked,) = [
                line.split()[1] for line in Path(f"/proc/{child.pid}/status").read_text().splitlines()
                if line.startswith("SigBlk")
            ]  # fmt: skip
            assert int(blocked, 16) >> signal.SIGINT - 1 & 1
