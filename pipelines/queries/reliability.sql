-- How well the weights of each policy separate correct from wrong labels, after `curate audit` (working database).
SELECT round, frames, overlap, policy, category, labels, right_labels, auroc, auroc_low, auroc_high,
       average_precision, weighted_precision, weighted_recall, reference, equal_recall_precision,
       calibration_error, calibration_error_limit
FROM audit
ORDER BY round, frames, overlap, category, auroc DESC
