from ._sumo_env import SumoEnv as SumoEnv
