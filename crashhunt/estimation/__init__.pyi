from ._comparison import Comparison as Comparison, HuntFigures as HuntFigures, compare as compare
