"""Studies: as-built instruments are drawn, calibrated and measured one by one, and their figures collected."""

from .study_file import StudyFile, builtin_studies, load_study

__all__ = ["StudyFile", "builtin_studies", "load_study"]
