"""Division of energy among jobs, and measurements with the real CodeCarbon."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from headway.config.experiment import EnergyConfig
from headway.contracts import HeadwayError
from headway.energy import meter
from headway.energy.gpu import gpu_shares
from headway.energy.ledger import Energy, EnergyLedger, JobUsage
from headway.energy.meter import EnergyMeter

GIB = 2**30
PARTS = ("cpu_kwh", "gpu_kwh", "ram_kwh", "kg_co2")


def _increment(cpu: float, gpu: float, ram: float) -> Energy:
    return Energy(cpu, gpu, ram, 0.1 * (cpu + gpu + ram))


@pytest.mark.parametrize("seed", range(20))
def test_all_shares_sum_to_the_total(seed: int) -> None:
    generator = np.random.default_rng(seed)
    ledger = EnergyLedger(0.0, cores=2, memory_bytes=8 * GIB)
    used = dict.fromkeys("abcd", 0.0)
    running, ended, now = set("abcd"), {}, 0.0
    for _ in range(40):
        now += generator.exponential(5)
        for job in sorted(running):
            # Reports may exceed the two cores' capacity, and often repeat the last one.
            used[job] += generator.choice([0.0, generator.exponential(6)])
        jobs = {job: JobUsage(used[job], int(generator.integers(0, 4 * GIB))) for job in sorted(running)}
        ledger.record(now, jobs, {"a": 0.7} if "a" in running else {})
        ledger.close_interval(now, _increment(*generator.exponential(1, 3)))
        if running and generator.random() < 0.1:
            job = sorted(running)[0]
            running.discard(job)
            ended[job] = ledger.settle(job)
    shares, idle, total = ledger.shares(), ledger.idle(), ledger.total()
    for part in PARTS:
        values = [getattr(share, part) for share in (*shares.values(), idle)]
        assert min(values) >= 0
        assert sum(values) == pytest.approx(getattr(total, part))
    for job, energy in ended.items():
        assert shares[job] == energy  # later reports of other jobs do not change it


def test_a_share_is_cpu_seconds_over_wall_times_cores() -> None:
    ledger = EnergyLedger(0.0, cores=4, memory_bytes=8 * GIB)
    ledger.record(10.0, {"busy": JobUsage(20.0, 2 * GIB), "light": JobUsage(4.0, 0)}, {"busy": 1.0})
    ledger.close_interval(10.0, _increment(40.0, 3.0, 8.0))
    busy, light, idle = *(ledger.shares()[job] for job in ("busy", "light")), ledger.idle()
    assert [getattr(busy, part) for part in PARTS[:3]] == pytest.approx([20, 3, 2])
    assert [getattr(light, part) for part in PARTS[:3]] == pytest.approx([4, 0, 0])
    assert [getattr(idle, part) for part in PARTS[:3]] == pytest.approx([16, 0, 6])
    assert busy.kg_co2 == pytest.approx(2.5)
    assert busy.cpu_seconds == 20.0


def test_rare_reports_do_not_change_a_job_s_share() -> None:
    often, rarely = (EnergyLedger(0.0, cores=1, memory_bytes=GIB) for _ in range(2))
    for second in range(1, 31):
        often.record(second, {"job": JobUsage(0.9 * second, 0)}, {})
        rarely.record(second, {"job": JobUsage(0.9 * (second // 10 * 10), 0)}, {})
        for ledger in (often, rarely):
            ledger.close_interval(second, _increment(1.0, 0.0, 0.0))
    assert often.settle("job").cpu_kwh == pytest.approx(27)
    assert rarely.settle("job").cpu_kwh == pytest.approx(27)


def test_cpu_seconds_before_the_measurement_are_not_charged() -> None:
    ledger = EnergyLedger(100.0, cores=1, memory_bytes=GIB)
    ledger.open("job", 50.0)
    ledger.record(110.0, {"job": JobUsage(55.0, 0)}, {})
    ledger.close_interval(110.0, _increment(10.0, 0.0, 0.0))
    assert ledger.settle("job").cpu_kwh == pytest.approx(5)


def test_an_unknown_part_is_none_and_never_zero() -> None:
    ledger = EnergyLedger(0.0, cores=1, memory_bytes=GIB)
    ledger.record(1.0, {"job": JobUsage(1.0, GIB)}, {"job": 1.0})
    ledger.close_interval(1.0, Energy(None, None, 2.0, 0.2))
    energy = ledger.settle("job")
    assert (energy.cpu_kwh, energy.gpu_kwh, energy.ram_kwh, energy.kwh) == (None, None, 2.0, 2.0)
    assert "cpu_kwh" not in energy.as_row()
    assert Energy(None, None, None, None).kwh is None


def test_seeds_of_a_stack_share_equally() -> None:
    whole = Energy(8.0, None, 4.0, 2.0, cpu_seconds=100.0)
    assert whole.per_seed(4) == Energy(2.0, None, 1.0, 0.5, cpu_seconds=25.0)


def test_gpu_energy_is_divided_by_the_utilisation_of_each_job_s_processes() -> None:
    jobs = {
        "a": JobUsage(0, 0, uses_gpu=True, process_ids=(1, 2)),
        "b": JobUsage(0, 0, uses_gpu=True, process_ids=(3,)),
        "c": JobUsage(0, 0, process_ids=(4,)),
    }
    assert gpu_shares(jobs, {1: 20.0, 2: 10.0, 3: 10.0, 4: 50.0}) == {"a": 0.75, "b": 0.25}
    assert gpu_shares(jobs, {}) == {"a": 0.5, "b": 0.5}
    assert gpu_shares({"c": jobs["c"]}, {4: 1.0}) == {}


def test_a_country_without_data_is_named() -> None:
    with pytest.raises(HeadwayError, match="did you mean BRA"):
        EnergyMeter.start(EnergyConfig(country="BRAZ"))
    with pytest.raises(HeadwayError, match="did you mean PRT"):
        EnergyMeter.start(EnergyConfig(country="Portugal"))
    with pytest.raises(HeadwayError, match="write its ISO 3166-1 alpha-3 code"):
        EnergyMeter.start(EnergyConfig(country="7"))


def test_without_a_country_energy_is_known_and_its_co2_is_not() -> None:
    assert EnergyConfig().country is None
    running = EnergyMeter.start(EnergyConfig())
    running.wait()
    job = running.finish("job", {}, JobUsage(0.5, 2**30))
    total = running.stop().total
    assert (job.kg_co2, total.kg_co2) == (None, None)
    assert total.kwh is not None
    assert total.kwh > 0
    assert "kg_co2" not in total.as_row()


def test_a_failure_of_codecarbon_is_a_notice_and_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(config: object, readings: object) -> None:
        raise OSError("no sensors")

    monkeypatch.setattr(meter, "make_tracker", fail)
    running = EnergyMeter.start(EnergyConfig())
    report = running.stop()
    assert report.total.kwh is None
    assert report.total.kg_co2 is None
    [line] = running.notices()
    assert "no sensors" in line


def test_measuring_may_be_switched_off() -> None:
    running = EnergyMeter.start(EnergyConfig(enabled=False))
    assert running.sample({"job": JobUsage(1.0, 1)})["job"].kwh is None
    assert running.stop().total.kwh is None
    assert running.notices() == ()


_SESSION = """
import json, os, socket, sys, time
def refuse(*arguments):
    print("connected to", arguments, file=sys.stderr)
    os._exit(3)
socket.socket.connect = socket.socket.connect_ex = socket.getaddrinfo = refuse
from headway.config.experiment import EnergyConfig
from headway.energy.ledger import JobUsage
from headway.energy.meter import EnergyMeter
assert not {"codecarbon", "pynvml"} & set(sys.modules)
began = time.perf_counter()
meter = EnergyMeter.start(EnergyConfig(country="FRA"))
assert time.perf_counter() - began < 1, "start-up must not wait for it"
while meter.sample({"job": JobUsage(0.0, 0)})["job"].kwh is None:
    assert time.perf_counter() - began < 30, meter.notices()
    time.sleep(0.1)
spent = time.process_time()
while time.process_time() - spent < 0.3:
    meter.sample({"job": JobUsage(0.5 * (time.process_time() - spent), 2**30)})
    sum(range(1_000_000))
meter.finish("job", {}, JobUsage(0.15, 2**30))
report = meter.stop()
final = meter._tracker.final_emissions_data
parts = [*report.jobs.values(), report.session, report.idle]
print(json.dumps({
    "parts": [part.as_row() for part in parts], "total": report.total.as_row(), "files": os.listdir(),
    "tracker": {"cpu_kwh": final.cpu_energy, "ram_kwh": final.ram_energy, "kg_co2": final.emissions,
                "kwh": final.energy_consumed},
    "modes": report.modes.as_tags(),
}))
"""


def test_real_codecarbon_offline_and_quiet(tmp_path: Path) -> None:
    # A user's settings that would send data over the network must not take effect.
    (tmp_path / ".codecarbon.config").write_text(
        "[codecarbon]\nemissions_endpoint=http://127.0.0.1:9\nsave_to_api=true\nco2_signal_api_token=x\n"
        "save_to_file=true\nlog_level=debug\ncloud_provider=aws\ncloud_region=us-east-1\n"
    )
    command, home = [sys.executable, "-c", _SESSION], {**os.environ, "HOME": str(tmp_path)}
    session = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=home, check=False)
    assert session.returncode == 0, session.stderr
    assert session.stderr == ""
    result = json.loads(session.stdout)
    assert result["files"] == [".codecarbon.config"]
    for name, value in result["tracker"].items():
        assert result["total"][name] == pytest.approx(value)
        assert sum(part[name] for part in result["parts"]) == pytest.approx(value)
    job, own, _ = result["parts"]
    assert 0 < job["cpu_kwh"] < own["cpu_kwh"]
    # France's grid: tens of grams per kWh, not the hundreds of the world's average.
    assert 0.01 < result["tracker"]["kg_co2"] / result["tracker"]["kwh"] < 0.1
    assert result["modes"]["energy.ram"].startswith("estimated")
