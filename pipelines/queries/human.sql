-- Human decisions from reviews, per category: objects have weight 1, rejected predictions 0.
SELECT round, policy, category, sum(CASE WHEN weight > 0 THEN 1 ELSE 0 END) AS objects,
       sum(CASE WHEN weight > 0 THEN 0 ELSE 1 END) AS rejected
FROM weighted_labels
WHERE provenance = 'human'
GROUP BY round, policy, category
ORDER BY round, policy, category
