"""The command line ``recrl-sweep``: arguments, commands, and what a terminal shows."""
