"""Adapters of planners that others wrote; each module needs the package of its planner (extra ``planners``)."""
