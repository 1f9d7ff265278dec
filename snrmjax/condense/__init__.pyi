from .load_cases import ReductionBasis, StaticCases

__all__ = ["ReductionBasis", "StaticCases"]
