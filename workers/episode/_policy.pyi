from numpy import float32, float64, int32
from numpy.typing import NDArray

def act(
    parameters: NDArray[float32],
    widths: NDArray[int32],
    observation: NDArray[float32],
    out: NDArray[float64],
    offset: float,
    scale: float,
    /,
) -> None: ...
