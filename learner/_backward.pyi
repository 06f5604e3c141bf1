from numpy import float32, int64
from numpy.typing import NDArray

def improve(
    F: NDArray[float32],
    R_inverse: NDArray[float32],
    P: NDArray[float32],
    model: NDArray[int64],
    residual: NDArray[float32],
    root: NDArray[float32],
    deviation: NDArray[float32],
    K: NDArray[float32],
    k: NDArray[float32],
    change: NDArray[float32],
    /,
) -> int: ...
