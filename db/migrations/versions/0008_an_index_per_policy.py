"""One index per policy of its weights by value."""

import sqlalchemy as sa
from alembic import op

from db.weight_index import PREFIX, index_of

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    op.drop_index("ix_weight_policy_v", "weight")
    connection = op.get_bind()
    for (policy,) in connection.execute(sa.text("SELECT DISTINCT policy FROM label_count")).all():
        connection.execute(sa.schema.CreateIndex(index_of(policy)))


def downgrade() -> None:
    """Downgrade the schema."""
    for index in sa.inspect(op.get_bind()).get_indexes("weight"):
        if str(index["name"]).startswith(PREFIX):
            op.drop_index(str(index["name"]), "weight")
    op.create_index("ix_weight_policy_v", "weight", ["round", "policy", "v"])
