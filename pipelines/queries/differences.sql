-- Which differences between two policies are real, after `curate audit`, and which may be chance (working database).
SELECT round, frames, overlap, category, figure, policy, other, difference, low, high,
       CASE WHEN real = 1 THEN 'real' ELSE 'may be chance' END AS verdict
FROM audit_difference
ORDER BY round, frames, overlap, category, figure, policy, other
