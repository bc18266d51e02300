"""Evaluation of artefacts and parts by the field's definitions: plain arrays in, a number with its N out.

Nothing here knows where the points come from. Definitions are after the standards that the modules name; their texts
were not at hand, so that no result is a statement of conformity.
"""
