"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates."""
