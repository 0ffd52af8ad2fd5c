"""What a simulator is, to a scenario: its table, checks and files. Nothing here imports a simulator."""

__all__: list[str] = []
