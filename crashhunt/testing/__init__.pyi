from ._agent_contract import AgentContract as AgentContract
from ._backend_contract import BackendContract as BackendContract
from ._disturbance_contract import DisturbanceContract as DisturbanceContract
from ._executor_contract import ExecutorContract as ExecutorContract
from ._last_avoidable_step_check import EscapeCheck as EscapeCheck, check_escape as check_escape
from ._oracle_contract import OracleContract as OracleContract, drive as drive
from ._sampler_contract import SamplerContract as SamplerContract
from ._simulator_contract import SimulatorContract as SimulatorContract
from ._survives import Example as Example, assert_survives as assert_survives
