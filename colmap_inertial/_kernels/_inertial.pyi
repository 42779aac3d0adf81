"""Linear algebra and integration of the inertial estimators. Results are written in place."""

from colmap_inertial.core.arrays import Array, Int64Array

class ArrowFactor:
    """Cholesky factor of a chain of states, its rows and columns scaled by `unit`."""

    def substitute(self, sides: Array, *, half_done: bool = False) -> None:
        """Solve for `sides` (K, m, q) in place; the matrix is the one with its rows and columns scaled by `unit`.

        `half_done`: they are what `eliminate` left in `forward`. Where q is a multiple of 8, nothing is copied.
        """

    def selected_inverse(self, diagonal: Array, right: Array) -> None:
        """The inverse's blocks on the diagonal (K, m, m) and to the right of it (K - 1, m, m), scaled likewise."""

def eliminate(
    diagonal: Array,
    below: Array,
    border: Array,
    rhs: Array,
    unit: Array,
    products: Array,
    *,
    forward: Array | None = None,
    instruction_set: str = "",
) -> ArrowFactor | None:
    """Factor H = L L' of a chain with `unit`'s scaling; None where it is not positive definite.

    `products` (n, n + q) becomes the product of L^-1 border (transposed) with L^-1 [border, rhs], and `forward`
    (K, m, n + q; the last rounded up to a multiple of 8) the latter.
    """

def add_information(
    here: Array,
    after: Array | None,
    by_globals: Array | None,
    *,
    first: int,
    column: int,
    diagonal: Array,
    below: Array,
    border: Array,
    corner: Array,
    instruction_set: str = "",
) -> None:
    """Add the products of the derivatives of residuals (N, r) to a chain's blocks.

    `here`, `after` (N, r, m): by the states `first ..` and the ones after them; `by_globals` (N, r, g): by the globals
    `column ..`.
    """

def preintegrate(
    *,
    nodes_s: Array,
    steps: Int64Array,
    gyro_t_s: Array,
    gyro: Array,
    gyro_slope: Array,
    accel_t_s: Array,
    accel: Array,
    accel_slope: Array,
    gyro_bias: Array,
    accel_bias: Array,
    gyro_matrix: Array,
    accel_matrix: Array,
    accel_delay_s: float,
    delay_step_s: float,
    rotation: Array,
    velocity: Array,
    position: Array,
    cov_gyro: Array,
    by_gyro_bias: Array,
    by_accel_bias: Array,
    by_gyro_gain: Array,
    by_accel_gain: Array,
    by_accel_delay: Array,
    rate: Array,
) -> None:
    """Increments over K intervals, each in its number of steps, as `Preintegrated` describes them."""

def whiten_tridiagonal(diagonal: Array, below: Array, sides: Array) -> float:
    """Divide `sides` (N, c) by the Cholesky factor of a tridiagonal matrix; half the logarithm of its determinant.

    The latter is nan where the matrix is not positive definite.
    """

def place_points(
    *,
    pose: Int64Array,
    point: Int64Array,
    world_from_imu: Array,
    imu_in_world: Array,
    points: Array,
    cam_from_imu: Array,
    imu_in_cam: Array,
    in_imu: Array,
    in_cam: Array,
) -> None:
    """Write M points of (P, 3) in the body frames of their poses, of N, and in the camera's (M, 3)."""

def apply_chain_rule(
    *,
    pose: Int64Array,
    since_s: Array,
    force: Array,
    rate: Array,
    reading: Array,
    vector: Array,
    turn: Array,
    world_from_imu: Array,
    velocity: Array,
    cam_from_imu: Array,
    imu_in_cam: Array,
    in_imu: Array,
    in_cam: Array,
    by_cam: Array,
    by_intrinsics: Array,
    line: Array,
    since_middle_s: Array,
    weight: Array,
    by_frame: Array,
    by_shared: Array,
    by_point: Array,
) -> None:
    """Write derivatives (M, 2, 9), (M, 2, q), (M, 2, 3) of observations, by the camera's: (M, 2, 3), (M, 2, k).

    N poses as in `inertial/refine/_residuals.py`; M observations, each of a `pose`, with a weight. Where q is k + 18,
    the last nine are by the gyroscope's gains.
    """

def reduce_points(
    *,
    first: Int64Array,
    place: Int64Array,
    by_frame: Array,
    by_shared: Array,
    by_point: Array,
    residual: Array,
    damping: float,
    wide: int,
    pitch: int,
    offset: Int64Array,
    end: Int64Array,
    values: Array,
    border: Array,
    corner: Array,
    rhs: Array,
    rhs_shared: Array,
    inverse: Array,
    pull: Array,
    instruction_set: str = "",
) -> bool:
    """Add the normal equations of a bundle adjustment without its P points; False where they lie outside the panels.

    Observations (M), point by point from `first` (P + 1): the `place` of their frames in the order, derivatives
    (M, 2, 9), (M, 2, q), (M, 2, 3) and residuals (M, 2). Row i of the frame at place a, column j of that at place b up
    to a stands at `offset[b] + (wide a + i) pitch + j` of the `values`, for a before `end[b]`.
    """

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
