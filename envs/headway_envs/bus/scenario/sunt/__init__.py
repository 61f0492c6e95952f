"""Import of scenarios from raw files of SUNT, which users download themselves.

SUNT is Salvador Urban Network Transportation (LabIA-UFBA, CC BY 4.0, doi 10.17632/85fdtx3kr5.1).
"""
