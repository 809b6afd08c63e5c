"""The command line ``recrl-sweep``: arguments, commands, and terminal output."""
