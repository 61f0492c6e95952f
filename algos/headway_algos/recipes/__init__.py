"""Named algorithms: one short file each, its equations, its source and its composition."""
