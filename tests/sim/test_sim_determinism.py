"""Same seed, same bits; object, compiled loop and interpreter in step; sim stands alone."""

import ast
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from sim_rig import CONFIGS, plant

from sim.config import PlantConfig
from sim.kernels import advance, drive, sample

ROOT = CONFIGS.parent
NAMES = ["nominal", "mild", "harsh", "lab"]


def load(name):
    return PlantConfig.load(CONFIGS / "plants" / f"{name}.toml")


def drives(n):
    k = np.arange(n)[:, None]
    return np.round(16000 + 4000 * np.sin(0.05 * k + np.arange(3)) + 300 * np.sin(1.1 * k)).astype(np.int32)


def steps(n):
    """Periods of 200 us that jitter by a microsecond, with a short one now and then, as when a fault cuts a period."""
    return np.array([200 + (k % 3) - 1 if k % 17 else 43 for k in range(n)], np.int64)


@njit
def compiled_loop(params, state, rows, steps_us, out):
    for k in range(len(rows)):
        drive(params, state, rows[k])
        advance(params, state, steps_us[k])
        sample(params, state, out[k])


def by_object(p, n):
    out = []
    for row, dt in zip(drives(n), steps(n), strict=True):
        p.drive(row)
        p.advance_to(p.t_us + int(dt))
        out.append(p.sample())
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
def test_object_and_compiled_loop_agree_bit_for_bit(name):
    a, b = plant(load(name), seed=9), plant(load(name), seed=9)
    out = np.zeros((500, 3), np.int32)
    compiled_loop(b.params, b.state, drives(500), steps(500), out)
    assert (by_object(a, 500) == out).all()
    assert a.state.tobytes() == b.state.tobytes()
    assert np.ptp(out, axis=0).min() > 100


NOMINAL_M = [
    [1.6363894522237952e-06, 4.770408680800282e-06, 1.319224819901592e-05],
    [2.912953625796802e-06, 8.03685254295107e-08, 7.362117126427391e-06],
    [1.9903233744647023e-06, -4.7983502385229715e-06, 1.2995886856460492e-05],
    [-3.1944436301065084e-06, 4.7412867770785645e-06, 1.2582382623326768e-05],
    [1.3559970201682741e-06, 9.253852248493203e-07, 7.257508498875174e-06],
]
"""After each 40 periods of 200 us."""


def test_nominal_stays_as_it_is():
    """What figures of all times are compared on: the values of its file, and 200 periods from seed 1. Counts, noise
    included, to the bit; positions to what another machine's exp may round."""
    values = json.dumps(load("nominal").model_dump(mode="json"), sort_keys=True)
    assert hashlib.sha256(values.encode()).hexdigest()[:16] == "30bd7a8f9be207cf"
    p, counts, positions = plant(load("nominal"), seed=1), [], []
    for row in drives(200):
        p.drive(row)
        p.advance_to(p.t_us + 200)
        counts.append(p.sample())
        positions.append(p.position_m)
    assert hashlib.sha256(np.array(counts, "<i4").tobytes()).hexdigest()[:16] == "65c040c09887d316"
    np.testing.assert_allclose(positions[39::40], NOMINAL_M, rtol=0, atol=1e-18)


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_is_a_run(name):
    runs = [(by_object(p, 100), p.state.tobytes()) for p in (plant(load(name), seed=s) for s in (1, 1, 2))]
    assert runs[0][1] == runs[1][1]
    assert (runs[0][0] != runs[2][0]).any()


PROGRAM = """
import sys; sys.path[:0] = ["tests/rigs", "tests/sim"]
from sim_rig import plant
from test_sim_determinism import by_object, load
import hashlib
p = plant(load("harsh"), seed=3)
print(hashlib.sha256(by_object(p, 8).tobytes()).hexdigest(), *p.position_m.tolist())
"""


def test_it_runs_interpreted_too():
    """With the compiler off: the same counts, and positions to rounding (libraries' exp and sin may differ)."""
    env = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error::RuntimeWarning"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    digest, *position = done.stdout.split()
    p = plant(load("harsh"), seed=3)
    assert hashlib.sha256(by_object(p, 8).tobytes()).hexdigest() == digest
    np.testing.assert_allclose(p.position_m, [float(x) for x in position], atol=1e-16)


def test_sim_imports_nothing_of_ours():
    for path in sorted((ROOT / "sim").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert all(
                n.split(".")[0] in {"sim", "numpy", "numba", "scipy", "pydantic"} | sys.stdlib_module_names
                for n in names
            ), (
                Path(path).name,
                names,
            )


def test_every_printed_stage_file_makes_a_plant():
    from sim.config import Device

    for path in sorted((CONFIGS / "stages").glob("*.toml")):
        p = plant(load("nominal"), device=Device.load(path))
        p.advance_to(1000)
        assert np.abs(p.position_m).max() < 1e-18


def test_a_wrong_key_is_refused():
    with pytest.raises(ValueError, match="quality"):
        PlantConfig.model_validate({"damping": {"on": True, "quality": 3}})
