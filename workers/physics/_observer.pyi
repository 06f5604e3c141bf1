from numpy import float32, float64
from numpy.typing import NDArray

def bind(tables: bytes, /) -> None: ...
def survey(bars: NDArray[float64], /) -> tuple[int, float, float, float]: ...
def observe(
    bars: NDArray[float64],
    rest_lengths: NDArray[float64],
    face: int,
    element: int,
    target_x: float,
    target_y: float,
    nominal_m: float,
    out: NDArray[float32],
    /,
) -> float: ...
def extremes(bars: NDArray[float64], heights: NDArray[float64], cell_m: float, /) -> tuple[float, float]: ...
def steer(
    mean: NDArray[float64],
    departure: NDArray[float64],
    element: int,
    shortest_m: float,
    longest_m: float,
    out: NDArray[float64],
    /,
) -> None: ...
