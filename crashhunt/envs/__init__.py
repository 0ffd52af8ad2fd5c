"""Gymnasium environments on SUMO: ``crashhunt/SUMO-v0``."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._process import RemoteEpisodes as RemoteEpisodes
    from ._sumo_env import SumoEnv as SumoEnv

offer_lazily(__name__)
