from ._rare import (
    BLOCK as BLOCK,
    CertainInterval as CertainInterval,
    Estimated as Estimated,
    RareEstimate as RareEstimate,
    Root as Root,
    learn_forcing as learn_forcing,
    rare_estimate as rare_estimate,
    root_of as root_of,
)
