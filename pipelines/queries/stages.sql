-- Number of tasks of each stage by state, and the time they took (working database).
SELECT round, stage, variant, state, count(*) AS tasks, sum(seconds) AS seconds
FROM task
GROUP BY round, stage, variant, state
ORDER BY round, stage, variant, state
