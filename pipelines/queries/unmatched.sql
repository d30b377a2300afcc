-- Labels that no reprediction matched, per category; without this evidence SPSL and PSPSL give them weight 0.
WITH labels AS MATERIALIZED (SELECT round, policy, category, score, loss, provenance FROM weighted_labels)
SELECT round, policy, category, count(*) AS labels, count(*) - count(loss) AS unmatched,
       avg(CASE WHEN loss IS NULL THEN score END) AS mean_score_unmatched,
       avg(CASE WHEN loss IS NOT NULL THEN score END) AS mean_score_matched
FROM labels
WHERE provenance = 'detector'
GROUP BY round, policy, category
ORDER BY round, policy, category
