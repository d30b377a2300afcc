-- Training curves: loss and its terms, learning rate, gradient norm (working database).
SELECT round, policy, name, step, value
FROM training_statistics
ORDER BY round, policy, name, step
