"""Trained policies read from the folders of runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from headway.algorithms import chosen_algo
from headway.config.experiment import ExperimentConfig
from headway.config.schema import build
from headway.contracts import DescribedPolicy, EnvSpec, HeadwayError, PolicyNetwork
from headway.policies.description import Arrays, PolicyDescription
from headway.policies.stored_spec import spec_of
from headway.store.checkpoint import stored_parameters
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import RunRecord
from headway.store.run_plan import PLAN, RunPlan

_STORED_NAMES = {"gru_weight_hidden": "gru_weight_memory", "gru_bias_hidden": "gru_bias_memory"}
"""Names in checkpoints of those arrays that have another name in `PolicyNetwork`."""


@dataclass(frozen=True)
class TrainedRun:
    """The newest policy of a run, or its best."""

    description: PolicyDescription
    arrays: Arrays
    """Arrays of the network, by name."""
    acting: DescribedPolicy
    """The policy that rollout workers run."""
    parameters: Arrays
    """Parameters of `acting`."""
    spec: EnvSpec
    """Specification of the training environment."""
    notices: tuple[str, ...]
    """A line about each broken checkpoint that was skipped."""

    @classmethod
    def read(cls, folder: Path, best: bool = False) -> "TrainedRun":
        """Read the newest checkpoint of the run in `folder`.

        `best`: the policy at the evaluation with the highest return instead of the newest.
        Raises HeadwayError if the folder is not a run's or is incomplete, if it has no valid checkpoint, or
        if the algorithm's policy does not describe itself.
        """
        if not (folder / "config.yaml").exists():
            raise HeadwayError(f"{folder} is not the folder of a run: it has no config.yaml")
        mapping, plan, record = read_configuration(folder), RunPlan.read(folder), RunRecord.read(folder)
        algo, algo_config = chosen_algo(build(ExperimentConfig, {"algo": mapping.get("algo", {})}).algo)
        try:
            spec = spec_of(plan.spec)
            plan.stack.index(record.seed)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise HeadwayError(f"{folder / PLAN} is damaged ({error}): restore it") from error
        acting = algo.acting_policy(algo_config, spec.for_policies)
        if not isinstance(acting, DescribedPolicy):
            raise HeadwayError(
                f"policies of {record.algorithm} cannot be exported: its acting policy does not describe its "
                "network, as headway.api.DescribedPolicy does"
            )
        iteration, parameters, notices = stored_parameters(
            folder, acting, record.seed, plan.stack, spec.name, best
        )
        arrays = {name: parameters[_STORED_NAMES.get(name, name)] for name in acting.network.array_names}
        description = PolicyDescription(
            spec.agents,
            spec.observation_size,
            spec.action_space,
            spec.has_action_mask,
            acting.network,
            str(arrays["weight_0"].dtype),
            _origin(record, mapping, iteration),
            spec.observation_features,
            _normalisation(acting.network, arrays, spec.observation_size),
        )
        return cls(description, arrays, acting, parameters, spec, notices)


def _normalisation(network: PolicyNetwork, arrays: Arrays, size: int) -> dict[str, Any]:
    """Return the network's normalisation of the D = `size` numbers of an observation, as JSON values."""
    if not network.observation_clip:
        return {}
    named = {name: arrays[f"observation_{name}"][:, 0, :size].tolist() for name in ("mean", "scale")}
    return {**named, "clip": network.observation_clip}


def _origin(record: RunRecord, mapping: dict[str, Any], iteration: int) -> dict[str, Any]:
    versions = {key: record.tags[key] for key in ("version.headway", "git.revision") if key in record.tags}
    return {
        "run": record.run_id,
        "study": record.study,
        "seed": record.seed,
        "iteration": iteration,
        "algorithm": record.algorithm,
        "algo": mapping["algo"],
        "env": mapping["env"],
        **versions,
    }
