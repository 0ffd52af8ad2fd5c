from ._debugger import Look as Look
from ._disturbances import edited_disturbances as edited_disturbances, with_other_words as with_other_words
from ._judge import judge as judge
from ._prepare import Code as Code, ReplayOptions as ReplayOptions, Rerun as Rerun, prepare as prepare
from ._replay import confirm as confirm, replay as replay
from ._todays import is_todays as is_todays
from ._verdict import ReplayData as ReplayData, ReplayReport as ReplayReport
