"""A search's trials, kept by Optuna in a database: opened in one way, told in one way, whatever is searched."""

import importlib.metadata
import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Protocol

import optuna

from pkxyz_ctrl.config.files import ConfigError

_STATE = optuna.trial.TrialState


class Judgement(Protocol):
    """Of a choice. Constraints are kept where they are 0 or less; without a value nothing was run, for a reason."""

    @property
    def constraints(self) -> Mapping[str, float]:
        """By which share of the goal each is missed."""
        ...

    @property
    def figures(self) -> Mapping[str, float] | None:
        """What is told beside the value."""
        ...

    @property
    def value(self) -> float | None:
        """What is searched for."""
        ...

    @property
    def reason(self) -> str:
        """Why there is no value."""
        ...


def stored_study(
    name: str, storage: str, digest: str, first: Sequence[Mapping[str, float]], *, maximise: bool, asked: str
) -> optuna.Study:
    """The study of a problem in a database, made anew, with the choices ``first`` to begin with, or continued.

    ``digest``: of the problem. ``asked``: the option and what it said, as in ``--out: study.db``. Raises
    ``ConfigError`` for a database that can't be had, and for a study of that name with another problem.
    """
    optuna.logging.set_verbosity(logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    option = asked.partition(":")[0]
    try:
        study = optuna.create_study(
            study_name=name, storage=storage, direction="maximize" if maximise else "minimize", load_if_exists=True
        )
        there = study.user_attrs.get("digest")
        if there is None:
            for choice in first:
                study.enqueue_trial(dict(choice), skip_if_exists=True)
            study.set_user_attr("version", importlib.metadata.version("pkxyz-ctrl"))
            study.set_user_attr("digest", digest)
    except Exception as error:  # SQLAlchemy's, the driver's and Optuna's own have nothing in common
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{asked}: {line}; give another {option}, of a database that can be written") from None
    if there not in (None, digest):
        raise ConfigError(
            f"{asked}: its study {name!r} is of another problem (something that it is asked for, or a file of it, has "
            f"changed since); give another {option}"
        )
    return study


def tell(study: optuna.Study, trial: optuna.Trial, judgement: Judgement) -> None:
    """Keep what came of a choice; one without a value is pruned."""
    for name, beyond in judgement.constraints.items():
        trial.set_constraint(name, beyond)
    for name, value in (judgement.figures or {}).items():
        trial.set_user_attr(name, value if math.isfinite(value) else None)
    if judgement.reason:
        trial.set_user_attr("reason", judgement.reason)
    if judgement.value is None:
        study.tell(trial, state=_STATE.PRUNED)
    else:
        study.tell(trial, judgement.value)


def judged(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Trials that came to a verdict: neither failed nor waiting."""
    return study.get_trials(deepcopy=False, states=(_STATE.COMPLETE, _STATE.PRUNED))
