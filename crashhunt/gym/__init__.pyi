from ._backend import CrashRule as CrashRule, GymSetup as GymSetup
from ._simulator import GymSimulator as GymSimulator
