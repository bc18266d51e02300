"""Reports: one HTML page that stands alone, with figures, tables and a view of surfaces in three dimensions.

It knows results only, as they lie in files or memory, and nothing of any truth. ``page`` puts sections together,
``figures`` and ``graphs`` draw them, ``surface_view`` encodes what the browser draws itself, ``tables`` lays out rows,
and ``results`` makes the page of a result file.
"""
