"""What makes the companion to F3AMD run: measurements, ledger, times, pages and exports, command line.

It knows `f3amd_lib`, which does not know it. Importing the package imports none of its rooms.
"""
