from ._comparison import Comparison as Comparison, HuntFigures as HuntFigures, compare as compare
from ._rates import counting_rule as counting_rule, measure_rates as measure_rates, why_no_interval as why_no_interval
