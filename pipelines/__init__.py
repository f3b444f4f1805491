"""The commands, thin: parse, build, run; with the app and the evaluation, which need both `render` and `sdps`."""
