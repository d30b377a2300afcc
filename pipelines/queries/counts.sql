-- Number of labels that each policy weighted, keeps and trusts; fast for any number of labels (working database).
SELECT round, policy, category, labels, kept, trusted, weight
FROM label_count
ORDER BY round, policy, category
