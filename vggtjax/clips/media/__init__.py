"""Pictures and videos, whoever reads them: their order, which of them, and their pixels."""
