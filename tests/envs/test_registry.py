"""What the registry names can be loaded and called as the contract of its fields says."""

import pytest

from headway_envs.registry import ENTRIES

DRAWN = [name for name, entry in ENTRIES.items() if entry.renderer is not None]


@pytest.mark.parametrize("name", DRAWN)
def test_a_renderer_is_made_from_the_prepared_environment(name: str) -> None:
    entry = ENTRIES[name]
    assert entry.renderer is not None
    assert callable(entry.renderer(entry.prepare(entry.config())).render)
