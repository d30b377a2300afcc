-- Policies of a round side by side: how many of the same labels each keeps and trusts, and people decided.
WITH labels AS MATERIALIZED (SELECT round, policy, category, weight, provenance FROM weighted_labels)
SELECT round, policy, category, count(*) AS labels,
       sum(CASE WHEN weight > 0 THEN 1 ELSE 0 END) AS kept,
       sum(CASE WHEN weight > 0.5 THEN 1 ELSE 0 END) AS trusted, sum(weight) AS weight,
       sum(CASE WHEN provenance = 'human' THEN 1 ELSE 0 END) AS human
FROM labels
GROUP BY round, policy, category
ORDER BY round, category, policy
