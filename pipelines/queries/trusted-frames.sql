-- Frames with the most trusted labels: weight above 0.5.
SELECT round, policy, frame, count(*) AS trusted, sum(weight) AS weight, min(weight) AS least_weight
FROM weighted_labels
WHERE weight > 0.5
GROUP BY round, policy, frame
ORDER BY trusted DESC, weight DESC, round, policy, frame
