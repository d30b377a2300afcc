-- Number of labels that each policy weighted, keeps and trusts, and that people decided; fast for any number of labels (working database).
SELECT round, policy, category, sum(labels) AS labels, sum(kept) AS kept, sum(trusted) AS trusted,
       sum(weight) AS weight, sum(human) AS human
FROM (
    SELECT round, policy, category, labels, kept, trusted, weight, 0 AS human FROM label_count
    UNION ALL
    -- Predictions that people decided about no longer count with the weight of the policy ...
    SELECT w.round, w.policy, p.category, -1, CASE WHEN w.v > 0 THEN -1 ELSE 0 END,
           CASE WHEN w.v > 0.5 THEN -1 ELSE 0 END, -w.v, 0
    FROM human_match AS m
    JOIN weight AS w ON w.round = m.round AND w.frame_id = m.frame_id AND w.k = m.k
    JOIN prediction AS p ON p.round = m.round AND p.frame_id = m.frame_id AND p.k = m.k
    UNION ALL
    -- ... but as the person decided.
    SELECT round, policy, category, 1, CASE WHEN weight > 0 THEN 1 ELSE 0 END,
           CASE WHEN weight > 0.5 THEN 1 ELSE 0 END, weight, 1
    FROM weighted_labels
    WHERE provenance = 'human'
) AS counted
GROUP BY round, policy, category
HAVING sum(labels) > 0
ORDER BY round, policy, category
