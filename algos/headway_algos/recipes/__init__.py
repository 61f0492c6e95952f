"""Named algorithms, one short file each: equations, source and composition."""
