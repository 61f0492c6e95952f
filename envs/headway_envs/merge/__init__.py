"""Connected automated vehicles that merge from an on-ramp into a highway, among human drivers."""
