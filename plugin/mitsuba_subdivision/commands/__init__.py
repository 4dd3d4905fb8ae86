"""The commands of ``mitsuba-subdivision``: one module for each, or for two that belong together.

A new command is a module with a function ``add_parser(commands)``, which adds the command's parser and sets as its
default ``run`` the function that gets the parsed options and returns the exit status; and its name in `command_line`.
"""
