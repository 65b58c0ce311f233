"""Scalar sources over a lossy channel, the case with a solved optimum."""
