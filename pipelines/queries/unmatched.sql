-- Labels that no reprediction matched, per category; without this evidence SPSL and PSPSL give them weight 0.
SELECT round, policy, category, count(*) AS labels, count(*) - count(loss) AS unmatched,
       avg(CASE WHEN loss IS NULL THEN score END) AS mean_score_unmatched,
       avg(CASE WHEN loss IS NOT NULL THEN score END) AS mean_score_matched
FROM weighted_labels
WHERE provenance = 'detector'
GROUP BY round, policy, category
ORDER BY round, policy, category
