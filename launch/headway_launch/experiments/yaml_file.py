"""YAML files that users write."""

from pathlib import Path
from typing import Any

from headway.contracts.errors import HeadwayError
from headway.store.run_configuration import require_small_yaml


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file, as OmegaConf reads it: 1e-3 is a number.

    Empty if the file holds anything else. Raises HeadwayError if it is not valid YAML.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        text = path.read_text(encoding="utf-8")
        require_small_yaml(text)
        content = OmegaConf.to_container(OmegaConf.create(text))
    except (OSError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        problem = " ".join(str(error).split()).replace(' in "<unicode string>"', "")
        raise HeadwayError(f"{path} is not valid YAML: {problem}") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        return {}
    return {str(key): value for key, value in content.items()}
