"""The command line: configuration, supervision, console, viewer. Nothing imports it."""
