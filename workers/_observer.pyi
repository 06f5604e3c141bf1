from numpy import float32, float64
from numpy.typing import NDArray

def bind(tables: bytes, /) -> None: ...
def survey(positions: NDArray[float64], orientations: NDArray[float64], /) -> tuple[int, float, float, float]: ...
def observe(
    positions: NDArray[float64],
    orientations: NDArray[float64],
    velocities: NDArray[float64],
    angular_velocities: NDArray[float64],
    rest_lengths: NDArray[float64],
    face: int,
    element: int,
    target_x: float,
    target_y: float,
    nominal_m: float,
    out: NDArray[float32],
    /,
) -> float: ...
