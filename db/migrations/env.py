"""Run migrations on the connection that `db.session` passes, or on `-x url=...`."""

from alembic import context
from sqlalchemy import create_engine

from db.models import Base

connection = context.config.attributes.get("connection")
if connection is None:
    connection = create_engine(context.get_x_argument(as_dictionary=True)["url"]).connect()
if connection.dialect.name == "postgresql":
    # The models leave this out: every command would import the dialect of PostgreSQL for it.
    for table in Base.metadata.tables.values():
        for index in table.indexes:
            if (where := index.dialect_kwargs["sqlite_where"]) is not None:
                index.dialect_kwargs["postgresql_where"] = where
context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    render_as_batch=True,
    transaction_per_migration=False,
)
with context.begin_transaction():
    context.run_migrations()
