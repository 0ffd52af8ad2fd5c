"""Foundations of every other package: errors, plugin names, files, processes and text.

Its modules are independent, so import each module by its own name. Every other package exports its names in its
``__init__``.
"""
