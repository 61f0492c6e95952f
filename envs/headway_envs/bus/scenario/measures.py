"""What all makers of scenarios measure alike: distances, hours of travel times, the fastest bus."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

METRES_A_DEGREE = 111_320.0
"""Of latitude, and of longitude at the equator."""
FASTEST_MPS = 25.0
"""No bus drives faster than 90 km/h from stop to stop."""
TIMED_HOURS = np.arange(4, 27)
"""Hours for which travel times of links are written; earlier and later drives are of the nearest one."""


def distance_m(lat: Floats, lon: Floats, lat2: Floats, lon2: Floats) -> Floats:
    """Crow's distance by the local flat approximation at `lat`, m."""
    north = (lat2 - lat) * METRES_A_DEGREE
    east = (lon2 - lon) * METRES_A_DEGREE * np.cos(np.radians(lat))
    return np.asarray(np.hypot(north, east), dtype=np.float64)
