"""Acceptance of a profilometer by artefacts: each laid under the lenses, evaluated by the field's terms, and judged."""
