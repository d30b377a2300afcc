-- Labels with a high score and a low weight; provenance human: a person rejected it.
SELECT round, policy, frame, k, category, score, loss, points, rho_diff, rho_anno, weight,
       provenance
FROM weighted_labels
WHERE score >= 0.5 AND weight < 0.2
ORDER BY score - weight DESC, round, policy, frame, k
