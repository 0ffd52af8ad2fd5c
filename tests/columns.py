"""What makes of the tables of today those before columns were added to trials."""

FEWER_COLUMNS = (
    "DROP INDEX trials_by_danger",
    "DROP INDEX trials_by_outcome",
    "ALTER TABLE trials DROP COLUMN danger",
    "ALTER TABLE trials DROP COLUMN other_steps",
    "CREATE INDEX trials_by_outcome ON trials (outcome, time_to_collision_s, number, steps, seed)",
)
