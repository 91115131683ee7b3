"""Forward kinematics in closed form: the sixth-order polynomial of the paper's section II.A, for any r, L1 and L2.

With rho_i = r - lambda_i - delta, the platform's shadow p (relative to the centre) obeys |p + rho_i e_i| = L1 (Eq.
5): the three points -rho_i e_i lie on a circle of radius L1 about p. In the elementary symmetric functions of the
rho_i that reads

    e1^2 e2^2 - e1^3 e3 - e2^3 - 3 L1^2 e2^2 = 0,

a sextic in delta, of which Appendix A prints 16 times the expanded coefficients. Expanded it is badly conditioned.
Depressed about the mean, t = mean(r - lambda_i) - delta, with tau = t / L1 and the second and third symmetric
functions sigma_2, sigma_3 of the deviations (over L1), the terms in tau^5 and tau drop out:

    tau^6 - tau^4 - sigma_3 tau^3 - (2/3) sigma_2 tau^2 - sigma_2^2 (3 + sigma_2) / 27 = 0.

At rest it is tau^4 (tau^2 - 1) = 0; the device lives on the simple root tau = 1.
"""

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.stage import GeometryConfig
from pkxyz_ctrl.core.kinematics import geometry_record
from pkxyz_ctrl.elements.errors import GeometryError

Array = NDArray[np.float64]

_REAL_TO = 1e-9
"""Roots with a smaller imaginary part (of L1) count as real; a physical root is simple, and real to 1e-15."""


def rest_slider_m(geometry: GeometryConfig) -> float:
    """lambda_0 = r - delta_0 - L1 in m: distance of a slider from its base point at rest."""
    return geometry.base_radius_m - geometry.projection_rest_m - geometry.crank_length_m


def closure_polynomial(geometry: GeometryConfig, strokes_m: ArrayLike) -> Array:
    """Coefficients (7,), lowest power first, of the depressed sextic in tau
    for strokes (3,) in m relative to rest.
    """
    deviation = _deviations(geometry, strokes_m)
    a, b, c = deviation
    sigma_2, sigma_3 = a * b + b * c + c * a, a * b * c
    return np.array([-(sigma_2**2) * (3 + sigma_2) / 27, 0.0, -2 * sigma_2 / 3, -sigma_3, -1.0, 0.0, 1.0])


def link_projections_m(geometry: GeometryConfig, strokes_m: ArrayLike) -> NDArray[np.complex128]:
    """All six roots delta (6,) in m for strokes (3,): assembly modes of the loop,
    most of them complex or out of reach.
    """
    strokes = _three(strokes_m)
    tau = Polynomial(closure_polynomial(geometry, strokes)).roots().astype(complex)
    return np.asarray(geometry.projection_rest_m - strokes.mean() + geometry.crank_length_m * (1 - tau))


def position_by_sextic(geometry: GeometryConfig, strokes_m: ArrayLike) -> Array:
    """Position (3,) in m relative to rest for strokes (3,) in m: the one root that the device can be assembled at.

    Real, 0 < delta < L2, and every crank on the side of its slider that the rest pose has (minus before the root
    in Eq. 8). Raises ``GeometryError`` where there is none.
    """
    strokes = _three(strokes_m)
    record = geometry_record(geometry)[0]
    link, crank = float(record["link_m"]), geometry.crank_length_m
    e = np.asarray(record["e"])
    for root in sorted(
        link_projections_m(geometry, strokes), key=lambda delta: abs(delta - geometry.projection_rest_m)
    ):
        delta = float(root.real)
        if abs(root.imag) > _REAL_TO * crank or not 0 < delta < link:
            continue
        rho = crank + geometry.projection_rest_m - strokes - delta
        if not np.all(rho > 0):
            continue  # rho_i = L1 cos(theta_i) - p.e_i is near L1 on our branch; where it vanishes there is no circle
        shadow = _circumcentre(rho, e)
        if np.all(e @ shadow + rho > 0):
            # z - z_0 as a quotient: the difference of the two roots would lose digits
            drop = geometry.projection_rest_m - delta
            z0 = geometry.height_rest_m
            rise = drop * (geometry.projection_rest_m + delta) / (np.sqrt((link - delta) * (link + delta)) + z0)
            return np.array([shadow[0], shadow[1], rise])
    raise GeometryError(
        f"0 < delta < L2 = {link * 1e6:g} um is violated: at strokes ({', '.join(f'{q * 1e6:g}' for q in strokes)}) um "
        "no real root of the loop closure lies there"
    )


def appendix_coefficients(base_radius_m: float, crank_m: float, slider_m: ArrayLike) -> Array:
    """c_0 to c_6 of Appendix A for sliders lambda (3,): 16 times the expanded sextic in delta, any unit of length.

    With base radius 2 + 1/sqrt(2) mm and crank 1 mm these are the printed ones (the text names 2.5 mm). For
    comparison only: in double precision the expansion loses about five digits against ``closure_polynomial``.
    """
    outward = base_radius_m - _three(slider_m)
    rho = [Polynomial([a, -1.0]) for a in outward]
    e1 = rho[0] + rho[1] + rho[2]
    e2 = rho[0] * rho[1] + rho[1] * rho[2] + rho[2] * rho[0]
    e3 = rho[0] * rho[1] * rho[2]
    sextic = e1**2 * e2**2 - e1**3 * e3 - e2**3 - 3 * crank_m**2 * e2**2
    return np.asarray(16 * sextic.coef[:7])


def _three(values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise GeometryError(f"three finite strokes are needed, got {values!r}")
    return array


def _deviations(geometry: GeometryConfig, strokes_m: ArrayLike) -> Array:
    strokes = _three(strokes_m)
    return np.asarray((strokes.mean() - strokes) / geometry.crank_length_m)


def _circumcentre(rho: Array, e: Array) -> Array:
    """p (2,) with |p + rho_i e_i| equal for the three i: 2 p.(rho_i e_i - rho_j e_j) = rho_j^2 - rho_i^2."""
    point = rho[:, None] * e
    matrix = 2 * (point[:2] - point[2])
    return np.asarray(np.linalg.solve(matrix, (rho[2] - rho[:2]) * (rho[2] + rho[:2])))
