from ._process import RemoteEpisodes as RemoteEpisodes
from ._sumo_env import SumoEnv as SumoEnv
