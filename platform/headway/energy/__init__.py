"""Energy and CO2 of a session's jobs, measured by CodeCarbon; the jobs' shares sum to the session's total.

Importing this package imports neither CodeCarbon nor NVML.
"""

from headway.energy.ledger import Energy, JobUsage
from headway.energy.meter import EnergyMeter, EnergyReport
from headway.energy.tracker import PowerModes

__all__ = ["Energy", "EnergyMeter", "EnergyReport", "JobUsage", "PowerModes"]
