"""Bus environment that reproduces the released code of BusEnv (github.com/LabIA-UFBA/BusEnv).

It serves for comparison with the table published with that code.
"""
