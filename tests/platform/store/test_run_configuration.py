"""The stored configuration of a run that cannot be read."""

from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from headway.store.run_configuration import read_configuration


def test_a_missing_configuration_is_named_once(tmp_path: Path) -> None:
    with pytest.raises(HeadwayError) as caught:
        read_configuration(tmp_path)
    assert str(caught.value) == f"{tmp_path}/config.yaml is missing: restore it, or remove this run's folder"
    (tmp_path / "config.yaml").symlink_to("config.yaml")
    with pytest.raises(
        HeadwayError, match=r"config\.yaml cannot be read \(Too many levels of symbolic links\)"
    ):
        read_configuration(tmp_path)
