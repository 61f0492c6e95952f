"""Files of networks and demand that a configuration names."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from headway.contracts import HeadwayError
from headway_envs.junctions.config import FOUR_WAY, SUMO_CONFIGURATION, JunctionsConfig

_DIGITS = 12
FOUR_WAY_FILE = Path(__file__).with_name("networks") / f"{FOUR_WAY}.net.xml"
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


@dataclass(frozen=True)
class Files:
    """Paths of the files of one configuration."""

    network: Path
    demands: tuple[Path, ...]
    """Route file of each demand; empty for vehicles per hour."""
    notices: tuple[str, ...] = ()
    """Lines that the user should see."""

    @classmethod
    def of(cls, config: JunctionsConfig) -> "Files":
        """Return the files that a configuration names. Raises HeadwayError for an unusable .sumocfg."""
        own = () if config.vph else tuple(map(Path, config.demands))
        if config.network == FOUR_WAY:
            return cls(FOUR_WAY_FILE, own)
        path = Path(config.network)
        if path.suffix != SUMO_CONFIGURATION:
            return cls(path, own)
        root = read_xml(path, "network", ("configuration", "sumoConfiguration"))
        values = {option.tag: option.attrib["value"] for option in root.iter() if "value" in option.attrib}
        network, routes = (values.pop(name, "") for name in ("net-file", "route-files"))
        if not network:
            raise HeadwayError(f"env.args.network: {path} has no net-file")
        if not own and not re.fullmatch(r"[^,]+", routes.strip()):
            raise HeadwayError(
                f"env.args.network: {path} must have one file as route-files, not {routes or 'none'}; join "
                "several into one, or set env.args.demand"
            )
        notice = f"{path}: only its network and its routes are used, not {', '.join(values)}"
        folder = path.parent
        return cls(folder / network, own or (folder / routes.strip(),), (notice,) if values else ())


def digest(config: JunctionsConfig) -> str | None:
    """Return the first digits of the SHA-256 of the files' contents without XML comments, in which SUMO's
    programs write the time. None: it names no files, or not all of them can be read."""
    try:
        files = Files.of(config)
        network = () if config.network == FOUR_WAY else (files.network,)
        contents = [_COMMENT.sub(b"", path.read_bytes()) for path in (*network, *files.demands)]
    except (OSError, HeadwayError):
        return None
    sums = b"".join(sha256(content).digest() for content in contents)
    return sha256(sums).hexdigest()[:_DIGITS] if contents else None


def read_xml(path: Path, key: str, roots: Sequence[str]) -> ElementTree.Element:
    """Return the root element of a SUMO file, which must be one of `roots`. Raises HeadwayError, naming the
    argument `key`, for any other file."""
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise HeadwayError(f"env.args.{key}: cannot read {path.absolute()}: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise HeadwayError(f"env.args.{key}: {path} is not XML: {error}") from error
    if root.tag not in roots:
        raise HeadwayError(
            f"env.args.{key}: {path} must be a SUMO file <{roots[0]}>, not one of <{root.tag}>"
        )
    return root
