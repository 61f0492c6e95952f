"""One file with the runs of a study, to publish beside a paper."""
