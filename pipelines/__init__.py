"""Thin entry points: parse, build, run. The only room that knows both `render` and `sdps`."""
