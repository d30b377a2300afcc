-- Labels with a weight above 0, and those that people decided, per category and distance from the LiDAR.
WITH placed AS MATERIALIZED (
    SELECT round, policy, category, weight, provenance,
           CASE WHEN x * x + y * y < 400 THEN '00-20 m'
                WHEN x * x + y * y < 1600 THEN '20-40 m'
                WHEN x * x + y * y < 3600 THEN '40-60 m'
                ELSE '60 m and more' END AS distance
    FROM weighted_labels
)
SELECT round, policy, category, distance, count(*) AS labels,
       sum(CASE WHEN weight > 0 THEN 1 ELSE 0 END) AS kept, sum(weight) AS weight,
       avg(weight) AS mean_weight,
       sum(CASE WHEN provenance = 'human' THEN 1 ELSE 0 END) AS human
FROM placed
GROUP BY round, policy, category, distance
ORDER BY round, policy, category, distance
