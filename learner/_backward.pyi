from numpy import float32, int64
from numpy.typing import NDArray

def improve(
    F: NDArray[float32],
    precision: NDArray[float32],
    precision_P: NDArray[float32],
    P_precision_P: NDArray[float32],
    model: NDArray[int64],
    gradient: NDArray[float32],
    hessian: NDArray[float32],
    deviation: NDArray[float32],
    K: NDArray[float32],
    k: NDArray[float32],
    change: NDArray[float32],
    /,
) -> int: ...
