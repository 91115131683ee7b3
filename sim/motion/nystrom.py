"""Dormand, El-Mikkawy and Prince's Runge-Kutta-Nystrom method of order 8 for x'' = f(t, x): 8 evaluations a step.

    X_i = x + c_i h v + h^2 sum_j A_ij f_j,   x+ = x + h v + h^2 sum_i B_i f_i,   v+ = v + h sum_i B_RATE_i f_i

J. R. Dormand, M. E. A. El-Mikkawy, P. J. Prince, High-order embedded Runge-Kutta-Nystrom formulae, IMA Journal of
Numerical Analysis 7 (1987) 423: RKN8(6)9FM, without its ninth stage, which serves the estimate of the error alone.
"""

import numpy as np

STAGES = 8

C = np.array([0.0, 1 / 20, 1 / 10, 3 / 10, 1 / 2, 7 / 10, 9 / 10, 1.0])
"""Where in the step each stage lies."""

_WEIGHTS: tuple[tuple[float, ...], ...] = (
    (),
    (1 / 800,),
    (1 / 600, 1 / 300),
    (9 / 200, -9 / 100, 9 / 100),
    (-66701 / 197352, 28325 / 32892, -2665 / 5482, 2170 / 24669),
    (227015747 / 304251000, -54897451 / 30425100, 12942349 / 10141700, -9499 / 304251, 539 / 9250),
    (
        -1131891597 / 901789000,
        41964921 / 12882700,
        -6663147 / 3220675,
        270954 / 644135,
        -108 / 5875,
        114 / 1645,
    ),
    (
        13836959 / 3667458,
        -17731450 / 1833729,
        1063919505 / 156478208,
        -33213845 / 39119552,
        13335 / 28544,
        -705 / 14272,
        1645 / 57088,
    ),
)
A = np.zeros((STAGES, STAGES))
"""Weight of stage j in the position of stage i, j < i."""
for _i, _row in enumerate(_WEIGHTS):
    A[_i, : len(_row)] = _row

B = np.array([223 / 7938, 0.0, 1175 / 8064, 925 / 6048, 41 / 448, 925 / 14112, 1175 / 72576, 0.0])
"""Weights of the position at the end."""

B_RATE = np.array([223 / 7938, 0.0, 5875 / 36288, 4625 / 21168, 41 / 224, 4625 / 21168, 5875 / 36288, 223 / 7938])
"""Weights of the velocity at the end."""
