-- Age parameter lambda (Eq. 4) and the range of the losses, per round and policy.
WITH labels AS MATERIALIZED (SELECT round, policy, loss, lambda_u, provenance FROM weighted_labels)
SELECT round, policy, count(*) AS labels, count(loss) AS matched,
       min(loss) AS least_loss, avg(loss) AS mean_loss, max(loss) AS greatest_loss,
       min(lambda_u) AS least_lambda, max(lambda_u) AS greatest_lambda
FROM labels
WHERE provenance = 'detector'
GROUP BY round, policy
ORDER BY round, policy
