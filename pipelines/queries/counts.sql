-- How many labels each policy has weighed, kept and trusts, at once for any number (working database).
SELECT round, policy, category, labels, kept, trusted, weight
FROM label_count
ORDER BY round, policy, category
