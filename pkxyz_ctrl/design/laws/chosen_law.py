"""The linear law that a controller file asks for: designed or taken as given, sampled, checked against the delayed
stage, and with what keeps it from winding up.
"""

from typing import Literal

import control
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.laws import SECTIONS, Linear, Matrices, Transfer
from pkxyz_ctrl.design.laws.glover_mcfarlane import hinf
from pkxyz_ctrl.design.laws.irc import irc
from pkxyz_ctrl.design.laws.pi_notch import pi_notch
from pkxyz_ctrl.design.laws.user_law import UnstableLawError, discrete_law, require_robust, state_space
from pkxyz_ctrl.design.margins.margins import Margins, spectral_radius
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, siso, stack
from pkxyz_ctrl.design.model.loop_plant import LoopPlant, loop_plant
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

SHARES = tuple(np.arange(1, 10) / 10.0)
"""Authorities, besides the full one, at which a law has to be stable too: it passes them on its way from rest."""


def chosen_law(stage: Stage, controller: ControllerConfig, bus: BusConfig) -> tuple[DiscreteLaw, Margins]:
    """The law pi_notch, irc, hinf or linear of a controller, and its margins at the operating strokes.

    Raises ``LawError`` where it can't be designed, and ``UnstableLawError`` where it is unstable with the sampled,
    delayed stage, at full authority or on the way there, or bears less than a quarter of a period more delay. A stage
    file says how much its sense chain lags, and not by what: as a filter and as a delay it has to do.
    """
    strokes = controller.operating_strokes_m
    plant, late = loop_plant(stage, bus, strokes), loop_plant(stage, bus, strokes, sense_lag="delay")
    law = _law(stage, controller, bus, plant)
    found = require_robust(law, plant)
    if stage.sense_delay_s > 0.0:
        require_robust(law, late)
    unwind = unwinding(law, plant)
    for share in SHARES:
        tried = at_authority(law, unwind, share)
        radius = max(spectral_radius(plant, tried), spectral_radius(late, tried))
        if radius >= 1.0:
            raise UnstableLawError(
                f"refused: the loop is stable, but not while its authority fades in (at {share:.0%} the spectral "
                f"radius is {radius:.4f}); lower the gain, or use a law that needs no feedback to be stable"
            )
    return law, found


def _law(stage: Stage, controller: ControllerConfig, bus: BusConfig, plant: LoopPlant) -> DiscreteLaw:
    if controller.pi_notch is not None:
        return pi_notch(plant, stage.mass_kg, controller.pi_notch)
    if controller.irc is not None:
        return irc(plant, controller.irc)
    if controller.hinf is not None:
        weights, plant = controller.hinf, loop_plant(stage, bus, plant.strokes_m, sense_lag="amplifier")
        return hinf(plant, (weights.plane, weights.plane, weights.z), weights.factor).law
    if controller.linear is not None:
        return linear_law(controller.linear, bus.period_s)
    raise LawError(f"{controller.law!r} is no linear law")


def linear_law(linear: Linear, period_s: float) -> DiscreteLaw:
    """The law of a section [linear], with a period. Raises ``LawError``."""
    dt = 0.0 if linear.period_us is None else linear.period_us * 1e-6
    if linear.matrices is not None:
        m = linear.matrices
        order = len(m.a)
        shapes = {"a": (order, order), "b": (order, 3), "c": (3, order), "d": (3, 3)}
        parts = {name: _matrix(getattr(m, name), name, shape) for name, shape in shapes.items()}
        return discrete_law(control.ss(*parts.values(), dt), period_s, linear.method)
    axes = [_axis(t, dt, period_s, linear.method) for t in linear.axis]
    return stack(period_s, axes * 3 if len(axes) == 1 else axes)


def _matrix(rows: tuple[tuple[float, ...], ...], name: str, shape: tuple[int, int]) -> Array:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise LawError(f"linear.matrices.{name} has to be {shape[0]} rows of {shape[1]} numbers")
    return np.array(rows, dtype=np.float64).reshape(shape)


def _axis(transfer: Transfer, dt: float, period_s: float, method: str) -> control.StateSpace:
    if not any(transfer.denominator):
        raise LawError("linear.axis.denominator is zero")
    system = siso(control.tf(list(transfer.numerator), list(transfer.denominator), dt))
    if dt == 0.0:
        return discretise(system, period_s, method)
    if abs(dt - period_s) > 1e-9 * period_s:
        raise LawError(
            f"linear.period_us is {dt * 1e6:g} and the bus has {period_s * 1e6:g} us; sample the law again, or give it "
            "continuous, without period_us"
        )
    return system


def linear_section(system: control.lti.LTI, method: Literal["tustin", "zoh"] = "tustin") -> Linear:
    """A python-control system of 3 inputs and outputs, or one of each for every axis, as the section [linear] of a
    controller: w = -K (y - r), N per m. Raises ``LawError``.
    """
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise LawError(f"a law is a StateSpace or a TransferFunction of python-control, not {type(system).__name__}")
    if system.dt is None or system.dt is True:
        raise LawError("the law does not say which period it has: set dt to 0 (continuous) or to the bus's period")
    period_us = None if system.dt == 0 else round(system.dt * 1e6)
    if period_us is not None and abs(period_us * 1e-6 - system.dt) > 1e-9 * system.dt:
        raise LawError(f"a period is a whole number of microseconds, not {system.dt * 1e6:g}")
    whole = system if system.ninputs == 3 else _on_every_axis(siso(system))
    found = whole if isinstance(whole, control.StateSpace) else state_space(whole)
    rows = {name: tuple(tuple(map(float, row)) for row in getattr(found, name.upper())) for name in "abcd"}
    return Linear(period_us=period_us, method=method, matrices=Matrices(**rows))


def with_law(
    controller: ControllerConfig, system: control.lti.LTI, method: Literal["tustin", "zoh"] = "tustin"
) -> ControllerConfig:
    """The controller with a law of the user's own in place of its law: all else, limits and monitors too, stays.

    It is plain data like any other, runs in every lane, is recorded, and can be written to a file. Raises ``LawError``;
    whether the loop is stable is found out by ``design_law``, which knows stage and bus.
    """
    others: dict[str, object] = dict.fromkeys(SECTIONS)
    name = f"{controller.name} with a linear law"
    section = {"law": "linear", "name": name, "linear": linear_section(system, method)}
    return ControllerConfig.model_validate({**dict(controller), **others, **section})


def _on_every_axis(axis: control.StateSpace) -> control.StateSpace:
    return control.ss(*[np.kron(np.eye(3), getattr(axis, name)) for name in "ABCD"], axis.dt)


def unwinding(law: DiscreteLaw, plant: LoopPlant) -> Array:
    """U (n,3) in 1/N for x+ = A x + B e + U s, s being the force asked for and not given.

    The steady Kalman gain of the law seen as a filter of white e, whose output is what was really given: A - U C is
    stable for any law, and where the law has no zeros outside the unit circle and gives much force for little error, U
    is Hanus's B D^-1. A tenth of the stage's stiffness stands in for D where that is small.
    """
    if law.order == 0:
        return np.zeros((0, 3))
    noise = 0.1 * np.diag(np.diag(plant.stiffness_n_per_m))
    r = law.d @ law.d.T + noise @ noise
    # balanced, as states of laws have all sizes: x = scale * unit state
    scale = np.sqrt(np.maximum(np.diag(_reach(law)), 1e-30))
    a, b, c = law.a * scale[None, :] / scale[:, None], law.b / scale[:, None], law.c * scale[None, :]
    force = float(np.sqrt(np.trace(r) / 3.0))
    s = b @ law.d.T / force
    q = b @ b.T + 1e-12 * np.eye(law.order)
    try:
        p = scipy.linalg.solve_discrete_are(a.T, c.T / force, q, r / force**2, s=s)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise LawError(
            f"nothing keeps this law from winding up ({error}): has it states that no output shows?"
        ) from error
    cc = c / force
    gain = np.linalg.solve(cc @ p @ cc.T + r / force**2, (a @ p @ cc.T + s).T).T / force
    return gain * scale[:, None]


def _reach(law: DiscreteLaw) -> Array:
    """Size of the states under white e: a Gramian with a slight decay, so that integrators have one too. By doubling,
    which is indifferent to the units of the states.
    """
    power = 0.99 * law.a / max(1.0, float(np.abs(np.linalg.eigvals(law.a)).max()))
    gramian = law.b @ law.b.T
    for _ in range(12):
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
    return gramian


def at_authority(law: DiscreteLaw, unwind: Array, share: float) -> DiscreteLaw:
    """What the tick makes of a law at authority ``share``, far from all limits."""
    rest = 1.0 - share
    return DiscreteLaw(
        law.period_s, law.a - rest * unwind @ law.c, law.b - rest * unwind @ law.d, share * law.c, share * law.d
    )
