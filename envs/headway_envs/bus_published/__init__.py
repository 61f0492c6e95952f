"""Bus environment that reproduces the released code of BusEnv (github.com/LabIA-UFBA/BusEnv), for comparison
with the table published with it."""
