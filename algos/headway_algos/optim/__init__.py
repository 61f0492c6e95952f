"""Optimisers, natural gradients and the compiled fast path."""
