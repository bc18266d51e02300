"""What is wrong with a measurement, why, what it costs, and what to do: from frames and calibrations alone.

Each module holds one kind of evidence, as functions from data to findings. `docs/diagnosis.md` says how each is found.
"""
