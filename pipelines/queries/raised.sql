-- Labels that a score threshold of 0.5 would drop and the weight keeps.
SELECT round, policy, frame, k, category, score, loss, points, rho_diff, rho_anno, weight,
       provenance
FROM weighted_labels
WHERE score < 0.5 AND weight > 0.3
ORDER BY weight - score DESC, round, policy, frame, k
