"""Energy and CO2 of a session's jobs, measured by CodeCarbon; the jobs' shares sum to the session's total."""
