from ._config import restore_classes as restore_classes
from ._simulator import HighwaySimulator as HighwaySimulator
