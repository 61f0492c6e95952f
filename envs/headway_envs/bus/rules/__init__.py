"""Rules of the bus environment: classical holding controllers, and baselines without holding.

fleet_state: the state that rules read; holding: baselines and threshold rules; literature: laws of the field
that compute a holding time, with tuned parameters.
"""
