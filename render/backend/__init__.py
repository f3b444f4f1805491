"""Mitsuba variant and LLVM, chosen before mitsuba is imported; helpers for Dr.Jit kernels."""
