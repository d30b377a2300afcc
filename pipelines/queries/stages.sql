-- What each stage did and how long it took (working database).
SELECT round, stage, variant, state, count(*) AS tasks, sum(seconds) AS seconds
FROM task
GROUP BY round, stage, variant, state
ORDER BY round, stage, variant, state
