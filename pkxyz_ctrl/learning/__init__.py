"""Iterative learning for scans that repeat: what the loop errs in the same way every period is taken back beforehand.

The correction is a periodic shift of the reference, kept as harmonics of the scan. After each window of whole periods
the harmonics of what was still seen as an error are taken off it, as far as they stand out of the noise.
"""

from pkxyz_ctrl.learning.config import LearningConfig, LearningError
from pkxyz_ctrl.learning.learner import Learner
from pkxyz_ctrl.learning.timetable import Timetable, timetable

__all__ = ["Learner", "LearningConfig", "LearningError", "Timetable", "timetable"]
