"""The bus environment of the released code of BusEnv (github.com/LabIA-UFBA/BusEnv), made anew from what it
does, so that the study's published table can be set beside our own figures."""
