"""Policies that somebody drives: robots that run in a process of their own, for as long as somebody looks."""
