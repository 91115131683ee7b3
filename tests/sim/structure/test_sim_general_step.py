"""Table, flexible modes, shaking base and noisy voltages together: against scipy's DOP853, and in their energy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sim_rig import CONFIGS, config, counts, plant, settle
from sim_truth import stiffness_at
from test_sim_effects import MODES
from test_sim_integrator import PM, scan

from sim.config import PlantConfig
from sim.motion.geometry import strokes
from sim.motion.mechanics import acceleration, energy

LAB = PlantConfig.load(CONFIGS / "plants" / "lab.toml")
QUIET = {"amplifier_bandwidth": {"corner_hz": 30e3}}
ROOM = {
    "base_noise": {"density_m_per_s2_per_rt_hz": (1e-4, 2e-4, 1e-4)},
    "floor_vibration": {"velocity_m_per_s": 5e-5, "isolator_hz": 2.0},
    "mains": {
        "harmonics": ({"order": 1, "acceleration_m_per_s2": 1e-2, "voltage_v": 2e-3}, {"order": 3, "voltage_v": 1e-3})
    },
    "amplifier_noise": {"density_v_per_rt_hz": 6e-6, "corner_hz": 1e3, "lowest_hz": 0.03},
}  # fmt: skip


def polynomial(given, t):
    """Value (3,) of cubics (4, 3) in t."""
    return np.array([1.0, t, t * t, t**3]) @ given


def risen(record, at, v):
    """By what each comb's force rises as fingers that stand aside bend further, (3,): their balance by repetition, as
    the lateral force grows 50 times less with the bending than that of the springs."""
    q, bend, offset, gap = np.empty(3), np.zeros(3), record["aside_m"], record["finger_gap_m"]
    strokes(record, np.array([*at, 0.0, 0.0, 0.0]), q)
    push = 0.5 * record["force_gain_n_per_v2"] * gap * (record["overlap_rest_m"] + q) * v * v
    spring = record["lateral_n_per_m"] / (1 + (q / record["softening_m"]) ** 2)
    for _ in range(12):
        bend = push * (1 / (gap - offset - bend) ** 2 - 1 / (gap + offset + bend) ** 2) / spring
    return 1 / (1 - ((offset + bend) / gap) ** 2)


class FirstOrder:
    """The equations of docs/understand/plant.md as first-order ones of (table, modes, their rates, the combs'
    charge), over one period for which the plant has drawn how base and voltages move."""

    def __init__(self, p, lag_v):
        self.record, self.scratch, self.lag_v = p.params[0], p.state.copy()[0], lag_v
        self.scratch["force_n"] = 0.0
        self.target_v = p.state["target_v"][0].copy()
        self.shake, self.ripple, self.steady_n = (
            p.state[n][0].copy() for n in ("shake_m_per_s2", "ripple_v", "steady_n")
        )

    def slope(self, t, y):
        record, m = self.record, int(self.record["mode_count"])
        at, r, v, rr, charge_v = np.split(y, (3, 3 + m, 6 + m, 6 + 2 * m))
        table, comb, damping = record["mode_table"][:m], record["mode_comb"][:m], record["damping_per_s"]
        clean_v = self.target_v + self.lag_v * np.exp(-t / record["amplifier_s"])
        acting_v = clean_v - charge_v + polynomial(self.ripple, t)
        pose = [*(at - r @ table), *(v - rr @ table)]
        v2 = acting_v**2 * (risen(record, pose[:3], acting_v) if record["misaligned_on"] else 1.0)
        pushed = np.array(acceleration(record, self.scratch, v2, *pose)) + damping @ pose[3:]  # P / m
        a = pushed - damping @ v + self.steady_n / record["mass_kg"] - polynomial(self.shake, t)
        q = np.empty(3)
        strokes(record, np.array(pose), q)
        pull = record["force_gain_n_per_v2"] * (1 + record["fringe_per_m"] * q) * v2
        push = comb @ pull - record["mass_kg"] * table @ pushed
        own = record["mode_w2_per_s2"][:m] * r + record["mode_damping_per_s"][:m] * rr
        charging = (record["charging_fraction"] * clean_v - charge_v) / record["charging_s"] * record["charging_on"]
        return np.concatenate([v, rr, a, push * record["mode_per_kg"][:m] - own, charging])


def reference(p, drives, period_us):
    """Table and modes (n, 3 + m) at the end of each period by DOP853, and as the plant has them, moved on beside it."""
    m, h = int(p.params["mode_count"][0]), period_us * 1e-6
    s = p.state[0]
    y = np.concatenate([s["motion"][:3], s["modes"][0, :m], s["motion"][3:], s["modes"][1, :m], s["charge_v"]])
    volt = p.voltage_v
    theirs, ours = [], []
    for row in drives:
        p.drive(row)
        p.advance_to(p.t_us + period_us)
        lag = volt - s["target_v"]
        assert np.abs(lag).max() < p.params["slew_v_per_s"][0] * p.params["amplifier_s"][0]
        slope = FirstOrder(p, lag).slope
        y = solve_ivp(slope, (0.0, h), y, method="DOP853", rtol=1e-12, atol=1e-17, first_step=2e-6).y[:, -1]
        volt = s["target_v"] + lag * np.exp(-h / p.params["amplifier_s"][0])
        theirs.append(y[: 3 + m])
        ours.append(np.concatenate([s["motion"][:3], s["modes"][0, :m]]))
    return np.array(theirs), np.array(ours)


@pytest.mark.parametrize(
    "effects",
    [ROOM, {"flexible_modes": {"modes": MODES}}, ROOM | {"flexible_modes": {"modes": MODES}}],
    ids=["room", "modes", "both"],
)
def test_within_a_picometre_of_dop853(effects):
    p = plant(config(**QUIET, **effects), seed=5)
    theirs, ours = reference(p, scan(40_000 // 200, 200), 200)
    assert np.ptp(theirs, axis=0)[:3].min() > 1e-6
    assert np.abs(ours - theirs).max() < 1.0 * PM


def test_the_whole_lab_against_dop853():
    """Fringe, levitation, charging, fingers aside, tilt, temperature and drift with room and modes, to a picometre; the
    noise of the sense chain moves nothing."""
    p = plant(LAB, seed=5)
    theirs, ours = reference(p, scan(40_000 // 200, 200), 200)
    assert np.ptp(theirs, axis=0)[:3].min() > 1e-6
    assert np.abs(ours - theirs).max() < 1.0 * PM
    table, tilt = theirs[-1, :3], LAB.table_tilt
    turned = np.array([tilt.about_x_rad_per_m @ table, tilt.about_y_rad_per_m @ table, 0.0])
    assert np.abs(p.position_m - (table + np.cross(turned, tilt.arm_m))).max() < 1.0 * PM


def test_a_drive_that_slews_is_integrated_at_any_step():
    """Ramps end within steps: periods of 200 us against the same drive advanced in pieces of 25 us."""
    effects = {
        "flexible_modes": {"modes": MODES},
        "amplifier_bandwidth": {"corner_hz": 30e3},
        "slew": {"limit_v_per_s": 2e6},
    }
    coarse, fine = plant(config(**effects)), plant(config(**effects))
    for k in range(50):
        for p in (coarse, fine):
            p.drive(counts(100 + 20 * (k % 2), 90, 80 + 10 * (k % 3)))
        coarse.advance_to(200 * (k + 1))
        for t in range(1, 9):
            fine.advance_to(200 * k + 25 * t)
    assert np.abs(coarse.position_m - fine.position_m).max() < 10 * PM
    assert np.abs(coarse.stroke_m - fine.stroke_m).max() < 10 * PM


def whole_energy(p):
    """Kinetic and potential energy of table and modes, J."""
    record, s = p.params[0], p.state[0]
    m = int(record["mode_count"])
    r, rr, heavy = s["modes"][0, :m], s["modes"][1, :m], 1 / record["mode_per_kg"][:m]
    here = s["motion"].copy()
    here[:3] -= r @ record["mode_table"][:m]
    kinetic = record["mass_kg"] * (s["motion"][3:] ** 2).sum() + (heavy * rr**2).sum()
    return 0.5 * kinetic + energy(record, here) + 0.5 * (heavy * record["mode_w2_per_s2"][:m] * r**2).sum()


def test_what_a_mode_takes_the_table_gives():
    """Undamped and let go, the whole keeps its energy over 200 periods, while some of it goes to the modes and back."""
    heavy = [m | {"compliance_share": 0.3, "quality_factor": 1e9} for m in MODES]
    p = plant(config(flexible_modes={"modes": heavy}, damping={"on": False}))
    p.state["motion"][0, :3] = [0.3e-6, -0.2e-6, 0.5e-6]
    start, in_modes = whole_energy(p), []
    for k in range(1600):
        p.advance_to(200 * (k + 1))
        r, heavy_kg = p.state["modes"][0, 0, :2], 1 / p.params["mode_per_kg"][0, :2]
        in_modes.append(0.5 * (heavy_kg * p.params["mode_w2_per_s2"][0, :2] * r**2).sum() / start)
    assert whole_energy(p) == pytest.approx(start, rel=1e-4)
    assert max(in_modes) > 0.02


def test_modes_ring_where_the_linear_equations_say():
    """Frequencies of the coupled equations at rest, from mass and stiffness matrices, against spectra of 1 s."""
    modes = [m | {"compliance_share": 0.1, "quality_factor": 500.0} for m in MODES]
    p = plant(config(flexible_modes={"modes": modes}, damping={"quality_factor": 500.0}))
    record = p.params[0]
    kappa = np.hstack([np.eye(3), -record["mode_table"][:2].T])
    mass = np.diag(np.concatenate([np.full(3, record["mass_kg"]), 1 / record["mode_per_kg"][:2]]))
    stiff = kappa.T @ stiffness_at(record, np.zeros(3)) @ kappa
    stiff[3:, 3:] += np.diag(record["mode_w2_per_s2"][:2] / record["mode_per_kg"][:2])
    expected = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiff)).real)) / (2 * np.pi)
    assert expected[3] > 2600.0 * 1.001  # the table is not held fast: the mode is stiffer than alone
    p.state["motion"][0, :3] = [3e-9, 2e-9, 4e-9]
    p.state["modes"][0, 0, :2] = 2e-9, 2e-9
    shown = []
    for k in range(20_000):
        p.advance_to(50 * (k + 1))
        shown.append([*p.position_m, *p.state["modes"][0, 0, :2]])
    spectra = np.abs(np.fft.rfft(np.array(shown) * np.hanning(len(shown))[:, None], axis=0)).T
    above = [max(range(2000, 5000), key=lambda k: spectrum[k]) for spectrum in spectra[3:]]
    below = {max(range(400, 1000), key=lambda k: spectrum[k]) for spectrum in spectra[:3]}
    assert np.abs(np.sort(above) - expected[3:]).max() <= 1.0  # bins of 1 Hz
    assert all(min(abs(k - hz) for k in below) <= 1.0 for hz in (expected[0], expected[2]))


def test_a_force_on_the_table_moves_the_combs_as_combs_move_the_table():
    """Reciprocity, statically: compliance from force on the table to strokes equals that from comb forces to table."""
    modes = {"flexible_modes": {"modes": [m | {"compliance_share": 0.1} for m in MODES]}}
    pushed = plant(config(**modes))
    pushed.external_force_n = (0.0, 2e-6, 0.0)
    settle(pushed)
    still = plant(config())
    still.external_force_n = (0.0, 2e-6, 0.0)
    settle(still)
    by_force = (pushed.stroke_m - still.stroke_m)[0] / 2e-6
    pulled, bare = plant(config(**modes)), plant(config())
    for p in (pulled, bare):
        p.drive(counts(20, 0, 0))
        settle(p)
    force = pulled.params["force_gain_n_per_v2"][0, 0] * pulled.voltage_v[0] ** 2
    by_comb = (pulled.position_m - bare.position_m)[1] / force
    assert by_comb == pytest.approx(by_force, rel=5e-3)
    assert abs(by_comb) > 1e-6
