def pick():
    pass
