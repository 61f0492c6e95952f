"""Buses that hold, move and go to service on lines with stochastic demand and travel times."""
