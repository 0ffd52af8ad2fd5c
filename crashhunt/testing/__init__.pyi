from ._agents import AgentContract as AgentContract
from ._backends import BackendContract as BackendContract
from ._disturbances import DisturbanceContract as DisturbanceContract
from ._executors import ExecutorContract as ExecutorContract
from ._last_avoidable_step import EscapeCheck as EscapeCheck, check_escape as check_escape
from ._oracles import OracleContract as OracleContract, drive as drive
from ._samplers import SamplerContract as SamplerContract
from ._simulators import SimulatorContract as SimulatorContract
from ._survives import Example as Example, assert_survives as assert_survives
