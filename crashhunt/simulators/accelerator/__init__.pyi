from ._acceleration import Acceleration as Acceleration, accelerate as accelerate
from ._frame import Frame as Frame
from ._known import kind_of as kind_of, reason_against as reason_against
from ._network import Network as Network
from ._onlooker import Onlooker as Onlooker
from ._switch import switch_off as switch_off, switch_on as switch_on, why_not as why_not
from ._unasked import Unasked as Unasked
