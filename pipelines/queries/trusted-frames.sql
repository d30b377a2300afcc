-- Frames with the most trusted labels: weight above 0.5; human: decided by people.
SELECT round, policy, frame, count(*) AS trusted, sum(weight) AS weight, min(weight) AS least_weight,
       sum(CASE WHEN provenance = 'human' THEN 1 ELSE 0 END) AS human
FROM weighted_labels
WHERE weight > 0.5
GROUP BY round, policy, frame
ORDER BY trusted DESC, weight DESC, round, policy, frame
